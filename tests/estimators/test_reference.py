"""The program that the textbook moving horizon estimator solves."""

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings, HorizonSettings

from .episodes import simulate, started, tell
from .rows import RICH, averaged, update


@pytest.mark.parametrize("linearisation", ["paper", "trajectory"])
def test_the_program_of_a_window_is_the_papers_objective(linearisation):
    """z' H z + q' z is the sum of eq. 14 but for a constant, over stages with rows and counts."""
    episodes, rng = averaged(6), np.random.default_rng(1)
    horizon = HorizonSettings(horizon=3, linearisation=linearisation, arrival_noise=(0.1, 0.2))
    settings = EstimatorSettings(**{**vars(RICH), "mhe": horizon})
    mhe = started("mhe", "reference", episodes, settings)
    for k in range(6):
        mhe.predict(episodes.everyone, episodes.inputs[k])
        update(mhe, episodes, k)
    (window,), n = mhe.filters, mhe.model.n_states
    assert len(window.stages) == 4
    arrival = np.array([0.1, 0.2] * 19 + [RICH.demand.deviation] * 3)

    def objective(x):
        total = np.sum(((x[0] - window.stages[0].predicted) / arrival) ** 2)
        for stage, one in zip(window.stages, x, strict=True):
            gap = window.problem.z(stage.seen) - stage.C @ one - stage.e
            total += np.sum(gap**2 / stage.R)
        for stage, one, after in zip(window.stages, x, x[1:], strict=False):
            total += np.sum((after - stage.A @ one - stage.c) ** 2 / stage.Q)
        return total

    H, q = mhe.program(0)
    np.testing.assert_allclose(H, H.T, rtol=1e-9)
    constant = objective(np.zeros((4, n)))
    for x in rng.normal(size=(3, 4, n)):
        z = x.ravel()
        assert z @ H @ z + q @ z == pytest.approx(objective(x) - constant, rel=1e-9)


def test_an_arrival_is_what_was_predicted_not_what_later_measurements_make_of_it():
    """A smoothed arrival would count the window's measurements twice."""
    episodes = simulate(n_steps=9)
    mhe = started("mhe", "reference", episodes, EstimatorSettings(mhe=HorizonSettings(horizon=4)))
    predicted, unit = [episodes.start[0]], mhe.model.state_scale
    for k in range(9):
        mhe.predict(episodes.everyone, episodes.inputs[k])
        predicted.append(mhe.states[0])
        tell(mhe, episodes.everyone, episodes.observed[k], episodes.values[k], episodes.sigma)
        oldest = mhe.filters[0].stages[0]
        np.testing.assert_allclose(oldest.predicted * unit, predicted[max(0, k - 3)], rtol=1e-12)
    assert np.abs(oldest.solution - oldest.predicted).max() > 1e-4
