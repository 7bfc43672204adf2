"""Account and report of the release model `Paced`: public bounds on what a vehicle has spent."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dptse_env.config import resolve
from dptse_env.parts import privacy_report
from dptse_env.privacy import epsilon_of, mu_of
from dptse_env.release import PacedSettings

from .paced_worlds import COLUMNS, LIMIT, T, predicting, request
from .test_paced import LENGTH, ONE, SEGMENTS, crowd, started
from .worlds import Worlds


@settings(max_examples=40)
@given(st.data())
def test_the_account_bounds_every_ledger_and_never_decreases(data):
    asked = PacedSettings(
        adjacency=data.draw(st.sampled_from(["replace", "add_remove"])),
        unit=data.draw(st.sampled_from(["trip", "event"])),
        epsilon=data.draw(st.sampled_from([0.5, 5.0])),
    )
    release = started(asked, Worlds(crowd(15)), seed=1)
    squares = 2.0 if asked.adjacency == "replace" else 1.0
    mu, epsilon = 0.0, 0.0
    assert [array.tolist() for array in release.spent(ONE, ONE)] == [[0.0], [0.0]]
    for second in np.tile(np.arange(1, T + 1), 3).tolist():
        asking = data.draw(st.lists(st.integers(0, 5), max_size=3))
        speed = data.draw(st.sampled_from([0.0, 20.0, LIMIT]))
        asked_for = np.isin(np.arange(COLUMNS), asking)
        release.release(request(second, asked_for, predicting(30.0, speed)))
        (spent,), (loss,) = release.spent(ONE, ONE)
        assert mu <= spent <= mu_of(asked.epsilon, asked.delta)
        assert epsilon <= loss <= asked.epsilon * (1.0 + 1e-9)
        assert squares * release.ledgers.paid.max() <= spent**2 * (1.0 + 1e-9)
        assert spent == 0.0 or loss >= epsilon_of(spent, asked.delta) * (1.0 - 1e-9)
        mu, epsilon = spent, loss


def test_the_account_is_the_largest_price_of_each_second():
    release = started()
    charged = 0.0
    for second in range(1, 4):
        flags = np.isin(np.arange(COLUMNS), [second, 5])
        release.release(request(second, flags))
        charged += 2.0 * release.prices[0, flags].max()
        assert release.spent(ONE, ONE)[0][0] == pytest.approx(np.sqrt(2.0 * charged))


def test_all_of_mu_is_spent_in_the_end():
    release = started(PacedSettings(epsilon=0.5))
    for second in np.tile(np.arange(1, T + 1), 40).tolist():
        release.release(request(second))
    mu, epsilon = release.spent(ONE, ONE)
    assert mu == [release.mu]
    assert epsilon == pytest.approx([0.5])


@pytest.mark.parametrize("unit", ["trip", "event"])
@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
def test_the_report_says_what_is_guaranteed(unit, adjacency):
    privacy = {"unit": unit, "adjacency": adjacency, "pace": 0.7, "clip": 25.0}
    found = privacy_report(resolve("private-highway-v1", {"privacy": privacy}))
    mu = mu_of(5.0, 0.05)
    assert found.guarantee == (
        f"(5, 0.05)-differential privacy of count and flow together, for {found.protects}"
    )
    part = {"trip": "whole trip", "event": "second of a trip"}[unit]
    change = {"replace": "replaced by another", "add_remove": "added or removed"}[adjacency]
    assert found.protects == f"one vehicle's {part}, {change}"
    assert found.void_reasons == ()
    assert (found.preset, found.speed_release, found.boundary_inputs) == (
        "paced",
        "flow",
        "nominal",
    )
    assert found.mu == pytest.approx(mu, rel=1e-12)
    assert found.epsilon == pytest.approx(5.0, rel=1e-9)
    assert found.epsilon_strict == pytest.approx(epsilon_of(mu, 1e-4))
    squares = 2.0 if adjacency == "replace" else 1.0
    assert found.assumptions == {"budget": pytest.approx(mu**2 / squares)}
    assert found.details == {**privacy, "ratio": 1.0}
    shown = found.to_dict()
    assert json.loads(json.dumps(shown, allow_nan=False)) == shown
    assert None not in shown.values()


def test_true_boundary_inputs_void_the_guarantee():
    privacy = {"boundary_inputs": "true"}
    found = privacy_report(resolve("private-highway-v1", {"privacy": privacy}))
    assert (found.guarantee, found.void_reasons) == ("none", ("boundary_inputs",))


def test_expected_deviations_are_those_of_free_traffic():
    release = started()
    release.release(request(1, prediction=predicting(10.0, LIMIT)))
    sigma = 1.0 / np.sqrt(release.pacing.expected_price(np.full(SEGMENTS, LIMIT))) / LENGTH
    np.testing.assert_allclose(release.sigma, [sigma, PacedSettings().clip * sigma])
    assert 0.5 < sigma * LENGTH * np.sqrt(release.prices[0, 2]) < 2.0
