"""A short road, and configurations of it that are quick to attack."""

import dataclasses

import numpy as np

from agents.audit.attack import attack
from agents.audit.planner import choose_target, make_policy
from dptse_env.config import EnvConfig
from dptse_env.estimators.simple import OpenLoop
from dptse_env.release import RELEASE_MODELS
from dptse_env.traffic import SHORT_HIGHWAY, Demand

HORIZON = 40
ROAD = dataclasses.replace(
    SHORT_HIGHWAY, duration=HORIZON, demand=Demand(((0.0, 1000.0),), (100.0,)), incident=None
)
N_COLUMNS = ROAD.n_segments + ROAD.n_boundaries


def config(bandwidth=2, horizon=None, **privacy):
    privacy = {"preset": "capped", **privacy}
    if privacy["preset"] == "capped":
        privacy = {"cap": 6, **privacy}
    settings = RELEASE_MODELS.find(privacy["preset"]).settings_type(**privacy)
    return EnvConfig(ROAD, privacy=settings, bandwidth=bandwidth, horizon=horizon)


def paced(estimator="open_loop", bandwidth=2, **privacy):
    """The paced ledger at a strength at which few runs suffice."""
    setting = config(bandwidth, **{"preset": "paced", "epsilon": 5.0, **privacy})
    return dataclasses.replace(setting, estimator=estimator)


class HalfTheLimit(OpenLoop):
    """Predicts half the speed limit, from which vehicles can deviate to both sides alike."""

    def estimate(self):
        estimate = super().estimate()
        speed = np.full_like(estimate.speed, 0.5 * ROAD.speed_limit)
        return estimate._replace(speed=speed)


def assert_runs_do_not_depend_on_the_batch(setting, record):
    """Runs are the same however many are played at once, and differ by their seed."""
    worlds = choose_target(setting, record, "replaced", "hunter")
    policy = make_policy(setting, "adaptive", worlds)
    together = attack(setting, worlds, policy, 5, seed=3, progress=False)
    parts = attack(setting, worlds, policy, 5, seed=3, batch=2, progress=False)
    np.testing.assert_array_equal(together.scores, parts.scores)
    np.testing.assert_array_equal(together.distances, parts.distances)
    other = attack(setting, worlds, policy, 5, seed=4, progress=False)
    assert not np.isin(other.scores, together.scores).any()
