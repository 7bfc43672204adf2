"""A small suite on the short road, and policies that fail."""

import time

import numpy as np

from agents.suite.cells import Suite, SuiteCell
from dptse_env.schedules import Schedule

SHORT = "dptse_env:dptse/ShortHighway-v0"
KEYWORDS = {"estimator": "ekf", "bandwidth": 2, "horizon": 90}
SMALL = Suite(
    "small-v1",
    (
        SuiteCell("plain", "printed noise", SHORT, KEYWORDS, "2000:2003"),
        SuiteCell("wide", "three queries", SHORT, {**KEYWORDS, "bandwidth": 3}, "2000:2003"),
        SuiteCell("paced", "a guarantee", SHORT, {**KEYWORDS, "privacy": "paced"}, "2000:2003"),
    ),
)


class Raising(Schedule):
    """Raises where three segments may be queried."""

    def select(self, step, observation):
        if self.bandwidth == 3:
            raise KeyError("no third segment")
        return self.first_that_fit(np.tile(np.arange(6), (len(step), 1)))


class Nonsense:
    """Returns what no action encoding takes."""

    def __init__(self, action):
        self.action = action

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return self.action, state


too_few = Nonsense(np.zeros((2, 6)))
not_a_number = Nonsense(np.full((3, 6), np.nan))
text = Nonsense("all of them")
nothing = Nonsense(None)


class Slow(Schedule):
    """Sleeps for a minute at its third decision."""

    def select(self, step, observation):
        if step[0] == 2:
            time.sleep(60.0)
        return self.first_that_fit(np.tile(np.arange(6), (len(step), 1)))
