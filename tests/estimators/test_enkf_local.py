"""The EnKF's update of a long road, of which a taper leaves stretches."""

import numpy as np
import pytest

from dptse_env.estimators import EnsembleSettings, EstimatorSettings
from dptse_env.estimators.compiled import enkf
from dptse_env.estimators.compiled.enkf_local import make_near

from .episodes import run, simulate, started
from .test_band import rows_episodes


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
