"""Residuals of a few episodes, and what they say of the noise."""

import numpy as np
import pytest
from scipy.special import ndtr

from agents.audit.report import audit_environment, audit_one_run
from agents.audit.residuals import BATCH, ROUNDS, examine, residuals_of
from agents.environments import make_config
from dptse_env.parts import make_task
from dptse_env.release import Capped, Paced, Printed
from dptse_env.release.noise import Noise
from dptse_env.traffic import RecordLibrary
from tests.helpers import ROOT, SHORT

from .mechanisms import MECHANISMS, noisy
from .small import HORIZON, config

# --- the residuals of a release model -------------------------------------------------------------

DRAWN = []


class Remembered(Noise):
    def _draw(self, row, generator):
        super()._draw(row, generator)
        DRAWN.append((row, self._normal[row].copy()))


@pytest.mark.parametrize("base", [Printed, Capped, Paced])
def test_residuals_are_the_noise_of_what_was_released(base, record):
    DRAWN.clear()
    setting = config(preset=noisy(base, Remembered), estimator="ekf")
    residuals = residuals_of(setting, record)
    # Two blocks for an episode of 40 s; both episodes of a round draw theirs in turn.
    blocks = [block for row in range(BATCH) for each, block in DRAWN if each == row]
    episodes = np.array(blocks).reshape(BATCH, ROUNDS, -1, *residuals.shape[1:])[:, :, :HORIZON]
    drawn = episodes.swapaxes(0, 1).reshape(residuals.shape)
    seen = np.isfinite(residuals)
    np.testing.assert_allclose(residuals[seen], drawn[seen], atol=2e-3)
    # Two queries and a sensor in each second, of which one may be the same.
    assert make_task(setting).n_channels > seen.any(axis=2).sum(axis=1).min() >= 2
    again, other = residuals_of(setting, record), residuals_of(setting, record, seed=1)
    np.testing.assert_array_equal(again, residuals)
    assert not np.array_equal(other, residuals, equal_nan=True)


class NoiseOfItsOwn(Capped):
    """Adds noise twice, once as it likes."""

    def true_values(self, request):
        values = super().true_values(request)
        return values + np.random.default_rng().normal(size=values.shape)


class Unstated(Paced):
    """Does not state how large the noise is."""

    def release(self, request):
        return super().release(request)._replace(sigma=np.zeros((len(request.times), 8, 2)))


@pytest.mark.parametrize(
    ("mechanism", "message"),
    [
        (NoiseOfItsOwn, "whose attribute noise is all that is random, got .*NoiseOfItsOwn"),
        (Unstated, "that states positive deviations of its noise, got 0 from .*Unstated"),
    ],
)
def test_a_model_that_cannot_be_checked_says_so(mechanism, message, record):
    with pytest.raises(ValueError, match=f"^the audit needs a release model {message}"):
        residuals_of(config(preset=mechanism), record)


# --- what they say --------------------------------------------------------------------------------

N, COLUMNS = 480, 6


def white(generator, n=N, columns=COLUMNS):
    """Residuals of which half are not released."""
    residuals = generator.normal(size=(n, columns, 2))
    residuals[generator.random((n, columns)) < 0.5] = np.nan
    return residuals


def part(at, axis, factor):
    """Factors of one second or column."""
    factors = np.ones((N, COLUMNS, 2))
    factors[(slice(None),) * axis + (at,)] = factor
    return factors


def copied(channel, source, lag, sign=1.0):
    """Numbers in which two channels have one noise, the second some seconds later."""
    numbers = np.random.default_rng(9).normal(size=(N, COLUMNS, 2))
    numbers[(slice(None), *source)] = sign * np.roll(numbers[(slice(None), *channel)], lag)
    return numbers


FAULTS = {
    "0.000 times the stated deviation in second 77": lambda r: r * part(77, 0, 0.0),
    "times the stated deviation in channel 3": lambda r: r * part(3, 1, 0.7),
    "many numbers below ": lambda r: np.sqrt(3.0) * (2.0 * ndtr(r) - 1.0),
    " of the density of channel 1 and the speed of channel 4, 7 s later": (
        lambda r: r * 0.0 + copied((1, 0), (4, 1), 7)
    ),
    " of the speed of channel 2 and the speed of channel 5, 0 s later": (
        lambda r: r * 0.0 + copied((2, 1), (5, 1), 0, -1.0)
    ),
}
"""Wrong noise, by what is said of it."""


@pytest.mark.parametrize("said", FAULTS)
def test_wrong_noise_is_found_and_named(said):
    found = examine(FAULTS[said](white(np.random.default_rng(0))))
    assert found.is_rejected
    assert said in found.suspect


@pytest.mark.parametrize(("factor", "n"), [(3.0, N), (1.0, 4)])
def test_neither_more_noise_than_stated_nor_too_little_to_say_is_a_fault(factor, n):
    assert not examine(factor * white(np.random.default_rng(0), n)).is_rejected


def test_probabilities_are_those_of_white_noise():
    generator = np.random.default_rng(0)
    found = np.array([examine(white(generator, 60, 3)).p_value for _ in range(300)])
    # Binomial counts, within four deviations; Bonferroni's correction is never too small.
    assert 4 <= np.count_nonzero(found < 0.1) <= 51
    assert np.count_nonzero(found < 0.01) <= 10


# --- which attack finds which fault ---------------------------------------------------------------

PAGE = (ROOT / "docs" / "privacy" / "audit.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("name", MECHANISMS)
def test_the_page_says_which_attack_finds_a_broken_mechanism(name):
    setting = make_config(SHORT, {"epsilon": 5.0, "privacy": {"preset": MECHANISMS[name]}})
    record = RecordLibrary().get(setting.corridor, 0)
    one, two = audit_one_run(setting, record), audit_environment(setting, record, trials=500)
    verdicts = [each.attack.result.verdict for each in (two, one)]
    found = one.noise.is_rejected, *(each == "rejected" for each in verdicts)
    cells = " | ".join("rejected" if each else "–" for each in found)
    assert f"| {name} | {cells} |" in PAGE
