"""The EnKF's update of a long road, of which a taper leaves stretches."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import EnsembleSettings, EstimatorSettings
from dptse_env.estimators.compiled import enkf
from dptse_env.estimators.compiled.enkf_local import make_near
from dptse_env.model.compiled import CompiledARZModel
from dptse_env.model.network import MeasurementRows
from dptse_env.model.parameters import load_parameters

from ..model.roads import STRAIGHT
from .episodes import REFERENCE_SPEED, SIGMAS, Episodes, run, simulate, started


def rows_episodes(spans=(1, 3, 2, 1, 8)):
    """Flows over some of a plain road's eight segments, those of a row from its number on."""
    first = np.minimum(np.arange(len(spans)), 8 - np.array(spans))
    rows = MeasurementRows(first, np.array(spans), n_segments=8)
    return disturbed(replace(STRAIGHT, n_mainline=8), rows)


def disturbed(road, rows=None):
    """Sixty steps of flows on a road, with noise in the state and the measurements."""
    model = CompiledARZModel(
        road, load_parameters("w99-3lane"), reference_speed=REFERENCE_SPEED, rows=rows
    )
    rng, n_steps, s = np.random.default_rng(0), 60, model.n_segments
    density = 0.1 * model.jam_density * (1.0 + 0.25 * rng.normal(size=(1, s)))
    start = model.states(density, np.full((1, s), 60.0))
    ends = model.n_boundaries
    along = np.full((1, ends), 40.0), np.full((1, ends), 60.0)
    inputs = np.tile(model.boundary_inputs(*along), (n_steps, 1, 1))
    truth, state = np.empty((n_steps, 1, 2 * s)), start
    for k in range(n_steps):
        disturbance = 1.0 + 0.01 * rng.normal(size=2 * s)
        state = model.project(model.step(state, inputs[k]) * disturbance, "cone")
        truth[k] = state
    sigma = SIGMAS["flow"]
    values = np.stack([model.measure(x) for x in truth])
    values += sigma * rng.normal(size=values.shape)
    observed = rng.random(values.shape[:3]) < 0.6
    return Episodes(model, start, inputs, observed, values, truth, sigma)


@pytest.mark.parametrize("episodes", [simulate(n_steps=40), rows_episodes()], ids=["road", "rows"])
@pytest.mark.parametrize("taper", [0.25, 0.35])
def test_it_is_the_update_of_the_whole_road(episodes, taper, monkeypatch):
    """Both draw the same numbers; they differ by the order of sums."""
    settings = EstimatorSettings(enkf=EnsembleSettings(taper=taper))
    local = started("enkf", "compiled", episodes, settings)
    assert local._ensembles.near.rank.size == episodes.model.rows.n_rows
    monkeypatch.setattr(enkf, "make_near", lambda model, weights, _: make_near(model, weights, 9e9))
    whole = started("enkf", "compiled", episodes, settings)
    assert whole._ensembles.near.rank.size == 0
    for k in range(40):
        run(local, episodes, [k])
        run(whole, episodes, [k])
        assert not local.diverged.any()
        np.testing.assert_allclose(local.states, whole.states, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(local.innovations, whole.innovations, rtol=1e-6, atol=1e-6)


def test_a_taper_that_leaves_most_of_the_road_has_the_numbers_it_had():
    """The paper's road is 1.5 km long; the shipped settings have tapers of 1 km and more."""
    episodes = simulate(n_steps=1)
    for taper, is_local in ((0.74, True), (0.75, False), (1.0, False)):
        settings = EstimatorSettings(enkf=EnsembleSettings(taper=taper))
        near = started("enkf", "compiled", episodes, settings)._ensembles.near
        assert (near.rank.size > 0) == is_local


def test_what_is_no_number_diverges():
    episodes = simulate(n_steps=3)
    settings = EstimatorSettings(enkf=EnsembleSettings(taper=0.3))
    estimator = started("enkf", "compiled", episodes, settings)
    run(estimator, episodes, range(2))
    values = np.full_like(episodes.values[2], np.nan)
    estimator.update(episodes.everyone, episodes.observed[2], values, episodes.sigma)
    assert estimator.diverged.tolist() == [True]
    assert np.isfinite(estimator.states).all()
