"""The moving horizon estimator beside its reference, and programs without a solution."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import BACKENDS, EstimatorSettings, HorizonSettings
from dptse_env.estimators.mhe import normalised_bounds
from dptse_env.estimators.reference import solve
from dptse_env.estimators.window import ACTIVE_SET, NEWTON
from dptse_env.utils.kernels import Bundle
from tests.helpers import UNEVEN, pairwise

from .helpers import PLAIN, RICH, random_streams, run, simulate, started, step, update


def mhe_of(backend, episodes, start=None, settings=PLAIN, **own):
    return started("mhe", backend, episodes, replace(settings, mhe=HorizonSettings(**own)), start)


def assert_minimal(mhe, tolerance=1e-9):
    """Every episode's estimate ends its program's minimum, brought into the cone where it is so."""
    assert np.isin(mhe.solved, (ACTIVE_SET, NEWTON)).all(), mhe.solved
    assert not np.any(mhe.diverged | mhe.fallback)
    bounds, n, unit = mhe.settings.bounds, mhe.model.n_states, mhe.model.state_scale
    for e, state in enumerate(mhe.states):
        H, q = mhe.program(e)
        limits = (np.tile(b, len(q) // n) for b in normalised_bounds(mhe.model, bounds))
        end = solve(H, q, *limits)[-n:]  # the general solver's
        projected = mhe.model.project((end * unit)[None], bounds)[0]
        assert np.abs((projected - state) / unit).max() <= tolerance


# Beside the reference -----------------------------------------------------------------------------


def agree(compiled, reference, tolerance):
    """Compare programs, states, covariances, innovations and flags of both after a step."""
    for ours, theirs in zip(compiled.program(0), reference.program(0), strict=True):
        np.testing.assert_allclose(
            ours, theirs, rtol=0, atol=1e3 * tolerance * np.abs(theirs).max()
        )
    gap = np.abs(compiled.states - reference.states) / compiled.model.state_scale
    assert gap.max() <= tolerance
    np.testing.assert_allclose(compiled.covariances, reference.covariances, rtol=0, atol=tolerance)
    close = {"rtol": 0, "atol": 1e3 * tolerance}
    np.testing.assert_allclose(compiled.innovations, reference.innovations, **close)
    for mhe in (compiled, reference):
        assert not np.any(mhe.fallback | mhe.diverged)
    assert compiled.solved[0] == ACTIVE_SET  # which takes the least time


@pytest.mark.parametrize(
    ("release", "bounds", "linearisation", "settings", "horizon"),
    pairwise(
        ["rows", "flow", "speed", "uneven"], ["cone", "box"], ["published", "trajectory"],
        [RICH, PLAIN], [4, 1],
    ),
)  # fmt: skip
def test_backends_agree(release, bounds, linearisation, settings, horizon):
    """Over the growth of the window, and while it moves on; predictions may come in pairs.

    On rows that overlap with centres of their own, the rich ones with demand states, and on a road
    of segments of many kinds. Rounding feeds back by trajectories.
    """
    if release == "uneven":
        episodes = simulate(n_steps=horizon + 7, noise=2.0, road=UNEVEN)
    else:
        episodes = simulate(n_steps=horizon + 7, noise=2.0, release=release)
    own = {"bounds": bounds, "linearisation": linearisation, "horizon": horizon}
    both = [mhe_of(backend, episodes, settings=settings, **own) for backend in BACKENDS]
    for k in range(len(episodes.inputs)):
        for mhe in both:
            if k % 5 == 2:
                mhe.predict(episodes.everyone, episodes.inputs[k])
            step(mhe, episodes, k)
        agree(*both, 1e-7 if settings is RICH else 1e-8)
    for a, b in zip(*(mhe.estimate() for mhe in both), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("linearisation", ["published", "trajectory"])
def test_the_references_program_is_the_papers_objective(linearisation):
    """z' H z + q' z is the sum of eq. 14 but for a constant, over stages with rows and counts."""
    episodes, rng = simulate(n_steps=6, release="rows"), np.random.default_rng(1)
    own = {"horizon": 3, "linearisation": linearisation, "arrival_noise": (0.1, 0.2)}
    mhe = mhe_of("reference", episodes, settings=RICH, **own)
    run(mhe, episodes, range(6))
    (window,), n = mhe.filters, mhe.model.n_states
    assert len(window.stages) == 4
    arrival = np.array([0.1, 0.2] * 19 + [RICH.demand.deviation] * 3)

    def objective(x):
        total = np.sum(((x[0] - window.stages[0].predicted) / arrival) ** 2)
        for stage, one in zip(window.stages, x, strict=True):
            gap = window.problem.z(stage.seen) - stage.C @ one - stage.e
            total += np.sum(gap**2 / stage.R)
        for stage, one, after in zip(window.stages, x, x[1:], strict=False):
            gap = after - stage.A @ one - stage.c
            total += gap @ np.linalg.solve(stage.Q, gap)
        return total

    H, q = mhe.program(0)
    np.testing.assert_allclose(H, H.T, rtol=1e-9)
    constant = objective(np.zeros((4, n)))
    for x in rng.normal(size=(3, 4, n)):
        z = x.ravel()
        assert z @ H @ z + q @ z == pytest.approx(objective(x) - constant, rel=1e-9)


# Alone --------------------------------------------------------------------------------------------


POOR = [
    ("trajectory", "box", 1.0, "speed", 20),  # gradients are sums of large numbers that cancel
    ("trajectory", "cone", 0.0, "flow", 5),
    ("published", "box", 0.0, "speed", 1),
    ("published", "cone", 1.0, "flow", 5),
]


@pytest.mark.parametrize(
    ("linearisation", "bounds", "filling", "release", "horizon"),
    POOR,
)
def test_poor_starts_under_ten_times_the_noise_are_solved(
    linearisation, bounds, filling, release, horizon
):
    """A batch in states of its own, with demand states."""
    episodes = simulate(n=3, n_steps=40, noise=10.0, release=release)
    density = np.full((3, 19), filling) * episodes.model.jam_density
    density[2] = 0.5 * episodes.model.jam_density
    start = episodes.model.states(density, np.zeros((3, 19)))
    own = {"bounds": bounds, "linearisation": linearisation, "horizon": horizon}
    mhe = mhe_of("compiled", episodes, start, EstimatorSettings(demand=RICH.demand), **own)

    def check(k):
        if k in (2, 9, 20, 39):
            assert_minimal(mhe)

    run(mhe, episodes, range(40), watch=check)


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_exact_measurement_is_weighed_as_a_very_good_one(backend):
    episodes = simulate(n_steps=20)
    mhe = mhe_of(backend, episodes)
    run(mhe, episodes, range(20), sigma=np.zeros(2))
    assert not np.any(mhe.diverged | mhe.fallback)
    seen = episodes.observed[19, 0]
    gap = mhe.estimate().density[0, seen] - np.maximum(episodes.values[19, 0, seen, 0], 0.0)
    assert np.abs(gap).max() < 2.0


# Solvers that fail --------------------------------------------------------------------------------


def make_unsolvable(mhe, monkeypatch):
    """Bounds that no state is within, so that no trajectory passes for an optimum."""
    nowhere = mhe._windows._replace(lower=mhe._windows.upper + 1.0)
    monkeypatch.setattr(mhe, "arrays", Bundle(*mhe.model.dynamics, mhe.filters, nowhere))


def test_what_is_not_solved_leaves_the_prediction_and_a_flag(monkeypatch):
    episodes = simulate(n=2, n_steps=10)
    mhe = mhe_of("compiled", episodes)
    run(mhe, episodes, range(8))
    assert not mhe.fallback.any()
    make_unsolvable(mhe, monkeypatch)
    mhe.predict(episodes.everyone, episodes.inputs[8])
    predicted = mhe.states
    update(mhe, episodes, 8)
    assert mhe.fallback.tolist() == [True, True]
    assert mhe.diverged.tolist() == [False, False]
    np.testing.assert_array_equal(mhe.states, predicted)
    mhe.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    assert mhe.fallback.tolist() == [True, False]
    monkeypatch.undo()
    step(mhe, episodes, 9)
    assert_minimal(mhe)
