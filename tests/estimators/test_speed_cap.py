"""Reported speeds held to the speed limit, for every estimator."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings
from dptse_env.traffic import PAPER_HIGHWAY
from tests.helpers import Road, fast_and_slow

from .episodes import EVERY, assert_same, model_of, run, show, simulate, started

CAP = 0.7
FAST = [(name, "compiled") for name in ("ekf", "ukf", "enkf", "mhe", "blend", "recurrent")]


@pytest.mark.parametrize(("name", "backend"), fast_and_slow(EVERY, FAST))
def test_a_cap_holds_the_reported_speeds_and_nothing_else(name, backend):
    episodes = simulate(n=2, n_steps=4)
    speeds = np.tile(np.linspace(20.0, 95.0, 19), (2, 1))
    mixed = episodes.model.states(np.full((2, 19), 20.0), speeds)
    plain, held = (
        started(name, backend, episodes, settings, mixed)
        for settings in (EstimatorSettings(), EstimatorSettings(speed_cap=CAP))
    )
    for k in range(4):
        for one in (plain, held):
            run(one, episodes, [k])
        expected, found = show(plain), show(held)
        largest = CAP * PAPER_HIGHWAY.speed_limit
        assert (expected.speed > largest).any()
        assert (found.speed < largest).any() or name == "recurrent"
        speed = np.minimum(expected.speed, largest)
        if name == "blend":  # a mean of speeds that are held already
            assert (found.speed <= speed).all()
            speed = found.speed
        assert_same(expected._replace(speed=speed), found)


def test_the_cap_is_over_the_limit_of_the_road():
    slow = simulate(n_steps=1)
    road = Road(n_mainline=1, speed_limit=50.0)
    model = type(slow.model)(road, model_of("paper", "speed").parameters)
    start = model.states(np.full((1, 1), 20.0), np.full((1, 1), 80.0))
    episodes = replace(slow, model=model, start=start)
    for cap, speed in ((None, 80.0), (1.0, 50.0), (1.1, 55.0), (2.0, 80.0)):
        ekf = started("ekf", "compiled", episodes, EstimatorSettings(speed_cap=cap))
        np.testing.assert_allclose(ekf.estimate().speed, speed)
