"""Filters err no more as fixed sensors get more precise, and hardly more than without them.

Played on traffic kept for tests, paired by traffic seed and noise, with the settings that ship. A
filter that trusts a count to be a density writes queues into free traffic: such an EKF errs without
a query by 79, 126, 121 and 132 veh/km at the four budgets, and by 67 without any sensor.
"""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from agents.environments import PRIVATE
from agents.play import Cell, play
from agents.statistics import mean_interval
from dptse_env.utils.arrays import FloatArray

SEEDS = tuple(range(2032, 2048))
EPSILONS = (1.0, 5.0, 50.0, 1000.0)
FILTERS = ("ekf", "ukf", "enkf", "mhe", "blend")
CASES = [(name, n_queries) for name in FILTERS for n_queries in (0, 1)]
every_case = pytest.mark.parametrize(("estimator", "n_queries"), CASES)

MOST_GROWTH = 0.05
"""Upper end of 95 % intervals of how much errors may grow from a budget to the next."""
MOST_HARM = {(name, 1): 0.1 for name in FILTERS} | {
    ("ekf", 0): 0.03,
    ("enkf", 0): 0.03,
    ("blend", 0): 0.03,
    ("ukf", 0): 0.06,
    ("mhe", 0): 0.06,
}
"""Upper ends of 95 % intervals of how much larger errors may be with sensors than without.

Without queries those of UKF and MHE end at 5 %, of errors that are .7 and 1.3 % larger on average.
With one query and an epsilon of 1 sensors pay from the same budget: errors of density change by
-4 to 2 % with ends of up to 9 %, and those of speed by -1 to 3 %. From an epsilon of 5 on they are
smaller on average, but for the MHE's speeds at 5 (.7 %).
"""


@cache
def errors(
    estimator: str,
    n_queries: int,
    epsilon: float,
    sensed: bool = True,
    seeds: tuple[int, ...] = SEEDS,
    conditions: str = "random",
) -> FloatArray:
    """Return mean errors of density and speed of episodes on traffic seeds, shape (2, n)."""
    keywords = {"estimator": estimator, "epsilon": epsilon, "bandwidth": max(n_queries, 1)}
    keywords |= {"demand": conditions, "incident": conditions}
    if not sensed:
        keywords["corridor"] = {"fixed_sensors": []}
    policy = "round-robin" if n_queries > 0 else "none"
    rows = play(Cell(PRIVATE, policy, keywords), seeds)
    return np.array([[row["rmse_density"], row["rmse_speed"]] for row in rows]).T


@pytest.mark.slow
@every_case
def test_errors_do_not_grow_with_the_budget(estimator, n_queries):
    found = [errors(estimator, n_queries, epsilon) for epsilon in EPSILONS]
    for early, late in pairwise(found):
        for before, after in zip(early, late, strict=True):
            growth = mean_interval(after - before).high / before.mean()
            assert growth < MOST_GROWTH


@pytest.mark.slow
@every_case
def test_sensors_do_little_harm(estimator, n_queries):
    for epsilon in EPSILONS:
        # Without query and sensor there is no release, and no budget that matters.
        without = errors(estimator, n_queries, epsilon if n_queries > 0 else 5.0, sensed=False)
        found = errors(estimator, n_queries, epsilon)
        for with_sensors, alone in zip(found, without, strict=True):
            harm = mean_interval(with_sensors - alone).high / alone.mean()
            assert harm < MOST_HARM[estimator, n_queries]


def test_exact_sensors_write_no_queue_into_free_traffic():
    """With the noise that the settings had before, the EKF errs here by 159 veh/km."""
    own = {"seeds": (3,), "conditions": "preset"}
    found, without = (errors("ekf", 0, 1000.0, sensed, **own) for sensed in (True, False))
    assert (found < 1.1 * without).all()
