"""A short road, and configurations of it that are quick to attack."""

import dataclasses

import numpy as np

from agents.audit.attack import attack
from agents.audit.planner import Planner
from agents.audit.worlds import Trajectory
from dptse_env.config import EnvConfig
from dptse_env.estimators.simple import OpenLoop
from dptse_env.parts import privacy_report
from dptse_env.release import RELEASE_MODELS
from dptse_env.traffic import SHORT_HIGHWAY, Demand

HORIZON = 40
ROAD = SHORT_HIGHWAY.replaced(
    duration=HORIZON, demand=Demand(((0.0, 1000.0),), (100.0,)), incident=None
)
N_COLUMNS = ROAD.geometry.n_cells
SECONDS = np.arange(1, HORIZON + 1)


def config(bandwidth=2, horizon=None, estimator="open_loop", **privacy):
    """Contributions are capped at six if not told otherwise."""
    privacy = {"preset": "capped", **privacy}
    if privacy["preset"] == "capped":
        privacy = {"cap": 6, **privacy}
    settings = RELEASE_MODELS.find(privacy["preset"]).settings_type(**privacy)
    made = EnvConfig(corridor=ROAD, privacy=settings, bandwidth=bandwidth, horizon=horizon)
    return dataclasses.replace(made, estimator=estimator)


def paced(estimator="open_loop", **privacy):
    """The paced ledger at a strength at which few runs suffice."""
    return config(estimator=estimator, **{"preset": "paced", "epsilon": 5.0, **privacy})


class HalfTheLimit(OpenLoop):
    """Predicts half the speed limit, from which vehicles can deviate to both sides alike."""

    def estimate(self):
        estimate = super().estimate()
        speed = np.full_like(estimate.speed, 0.5 * ROAD.geometry.speed_limit)
        return estimate._replace(speed=speed)


def staying(segment, speed=0.0):
    return Trajectory.constant(SECONDS, segment, speed)


def runs_of(setting, worlds, n_runs=2, plan=None, **options):
    """Attack with the plan of a hunter, or one that is given."""
    plan = Planner(setting).plan(worlds) if plan is None else plan
    return attack(setting, worlds, plan, n_runs, progress=False, **options)


def reached(setting, worlds, plan=None, n_runs=2):
    """The largest distance of some runs over mu."""
    distances = runs_of(setting, worlds, n_runs, plan).distances
    return distances.max() / privacy_report(setting).mu
