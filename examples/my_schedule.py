"""A schedule of one's own: uncertain segments that were not queried for long.

python examples/my_schedule.py

`select` is given a batch of episodes and returns as many masks. A schedule is used by its class in
Python, and by ``module:Class`` on the command line:

dptse evaluate --env dptse/ShortHighway-v0 --policies examples.my_schedule:UncertainAndOld
"""

import gymnasium as gym
import numpy as np

import dptse_env
from dptse_env.schedules import Schedule

SEEDS = range(2000, 2008)


class UncertainAndOld(Schedule):
    """The segments with the largest product of the density's deviation and age."""

    def select(self, step, observation):
        """Return the segments to query in each of k episodes, as flags of shape (k, n)."""
        n = self.n_mainline  # ramps follow, which cannot be queried
        spread, age = (self.block(observation, name)[:, :n] for name in ("density_log_std", "age"))
        return self.highest(np.exp(spread) * (age + 0.05), step)


def main() -> None:
    """Compare the schedule with others on the same traffic and noise."""
    env = gym.make_vec("dptse/ShortHighway-v0", num_envs=len(SEEDS), traffic_seeds=list(SEEDS))
    for schedule in ("shift-ahead", "round-robin", "oldest-first", "speed-front", UncertainAndOld):
        rows = dptse_env.evaluate(env, schedule, SEEDS)
        errors = [-1000 * row["reward"] for row in rows]
        name = schedule if isinstance(schedule, str) else schedule.__name__
        print(f"{name:15} error x 1000: {np.mean(errors):.1f}")


if __name__ == "__main__":
    main()
