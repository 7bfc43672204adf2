"""Moving horizon estimation on rows of several segments, and with demand states."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import BACKENDS, HorizonSettings
from dptse_env.estimators.horizon import assemble
from tests.cases import pairwise

from .conftest import ORDERS
from .episodes import simulate, started
from .rows import PLAIN, RICH, averaged, every_row, update, with_rows

N_STEPS = 14


@pytest.mark.parametrize(
    ("settings", "linearisation", "bounds", "order"),
    pairwise([PLAIN, RICH], ["paper", "trajectory"], ["box", "cone"], ORDERS, n=4),
    indirect=["order"],
)
@pytest.mark.usefixtures("order")
def test_backends_agree_on_rows_that_overlap(settings, linearisation, bounds):
    """Programs, innovations and estimates, over the window's growth and its first moves."""
    episodes = averaged(N_STEPS)
    mhe = HorizonSettings(horizon=4, linearisation=linearisation, bounds=bounds)
    settings = replace(settings, mhe=mhe)
    compiled, reference = (started("mhe", kind, episodes, settings) for kind in BACKENDS)
    scale = compiled.model.state_scale
    for k in range(N_STEPS):
        for estimator in (compiled, reference):
            estimator.predict(episodes.everyone, episodes.inputs[k])
            update(estimator, episodes, k)
        assert not np.any(compiled.diverged | reference.diverged)
        assert not np.any(compiled.fallback | reference.fallback)
        for ours, theirs in zip(
            assemble(compiled.window(0)), assemble(reference.window(0)), strict=True
        ):
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6 * np.abs(theirs).max())
        gap = np.abs(compiled.states - reference.states) / scale
        assert gap.max() < 1e-6
        np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-8)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_segments_measured_singly_are_those_of_a_model_without_rows(backend):
    plain = simulate(n_steps=8, release="flow")
    S = plain.model.n_segments
    more = with_rows(plain.model, every_row(S, plain.model.network.n_mainline))
    without = started("mhe", backend, plain)
    given = started("mhe", backend, replace(plain, model=more))
    observed, values = np.zeros((1, more.rows.n_rows), bool), np.zeros((1, more.rows.n_rows, 2))
    sigma = np.tile(plain.sigma, (1, more.rows.n_rows, 1))
    for k in range(8):
        observed[:, :S], values[:, :S] = plain.observed[k], plain.values[k]
        for estimator in (without, given):
            estimator.predict(plain.everyone, plain.inputs[k])
        without.update(plain.everyone, plain.observed[k], plain.values[k], plain.sigma)
        given.update(plain.everyone, observed, values, sigma)
        np.testing.assert_allclose(given.states, without.states, rtol=1e-9)
        np.testing.assert_allclose(given.covariances, without.covariances, rtol=1e-7, atol=1e-12)
