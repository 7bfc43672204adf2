"""Gains of swaps: how much an episode's error falls when a queried segment is swapped for another.

Each gain is measured on paired forks of an episode: they start in the same second with the same
estimator and the same traffic, and make the same queries, except that a segment of the first query
is swapped in one of them. The difference of their errors over the next seconds therefore comes from
that swap alone. The policy does not react to a swap: near an optimum, its reaction is worth little.

Noise would drown the difference. In the first query it is therefore plus or minus sigma, which
matches the moments of the Gaussian up to the third, and every fork is run with either sign
(antithetic noise), which cancels all that is odd in it; in later seconds the noise is that of the
episode. The standard deviation of a measured gain is a third of that with Gaussian noise of one
sign.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dptse_env.evaluation import WARM_UP, Policy
from dptse_env.process import QueryProcess
from dptse_env.utils.arrays import Action, AnyArray, FloatArray, IntArray, Observation
from dptse_env.vector_env import SensorQueryVectorEnv


@dataclass(frozen=True)
class Swaps:
    """Gains of k swaps that were tried in m states.

    Attributes:
        observations: Of the states, shape (m, size).
        error: Mean one-second error, minus the reward, over the seconds after a state, shape (m,).
        state: Index of the state in which each swap was tried, shape (k,).
        added: Option that was queried, shape (k,).
        dropped: Option that was queried without the swap, shape (k,).
        gain: Decrease of the summed error over these seconds due to the swap, shape (k,).
        spent: Increase of the budgets that vehicles spend in them, shape (k,); zero where they
            have none.
    """

    observations: Observation
    error: FloatArray
    state: IntArray
    added: IntArray
    dropped: IntArray
    gain: FloatArray
    spent: FloatArray

    @classmethod
    def from_parts(cls, parts: Sequence[Swaps]) -> Swaps:
        """Return the swaps of all parts."""

        def joined(name: str) -> AnyArray:
            return np.concatenate([getattr(part, name) for part in parts])

        first = np.cumsum([0] + [len(part.observations) for part in parts[:-1]])
        return cls(
            joined("observations"),
            joined("error"),
            np.concatenate([n + part.state for n, part in zip(first, parts, strict=True)]),
            *(joined(name) for name in ("added", "dropped", "gain", "spent")),
        )


def try_swaps(
    env: SensorQueryVectorEnv,
    policy: Policy,
    seeds: Sequence[int],
    generator: np.random.Generator,
    *,
    seconds: int,
    trials: int,
) -> Iterator[Swaps]:
    """Run an episode of ``policy`` for each seed, and try swaps in states along the way.

    Args:
        env: One episode for each seed, actions ``slots``, autoreset disabled.
        policy: Acts by drawing.
        seeds: Of the episodes, n of them.
        generator: Draws the swaps, a queried segment for one of the rest, and the signs of noise.
        seconds: Seconds over which a gain is measured, and between two states.
        trials: Swaps in each state.

    Yields:
        The swaps of n states, of the same second in all episodes.

    Raises:
        ValueError: All options are queried, so that there is nothing to swap, they cost different
            amounts, or episodes end before a gain could be measured.
    """
    horizon, queries = env.config.horizon_steps, env.config.queries
    if queries.most_queries >= queries.n_options:
        raise ValueError(
            f"swaps need a bandwidth below {queries.n_options} segments, got {queries.bandwidth}"
        )
    if queries.costs_differ:
        raise ValueError(f"swaps need queries that cost the same, got {queries}")
    # The states of every round are at other seconds.
    first = min(WARM_UP, horizon // 4) + int(generator.integers(seconds))
    if first + seconds > horizon:
        raise ValueError(
            f"swaps need a horizon that leaves {seconds} s to measure a gain, got {horizon} s"
        )
    observation, _ = env.reset(seed=seeds)
    for _ in range(first):
        observation = env.advance(_drawn(policy, observation)).observation
    for _ in range((horizon - first) // seconds):
        before, shown, actions = env.process.fork(), observation, []
        for _ in range(seconds):
            actions.append(_drawn(policy, observation))
            observation = env.advance(actions[-1]).observation
        yield _tried(before, shown, actions, generator, trials)


def _drawn(policy: Policy, observation: Observation) -> Action:
    action: Action = policy.predict(observation, deterministic=False)[0]
    return action


def _tried(
    before: QueryProcess,
    shown: Observation,
    actions: Sequence[Action],
    generator: np.random.Generator,
    trials: int,
) -> Swaps:
    """Try swaps in the first of ``actions``, in every episode of ``before``."""
    n, every = len(shown), np.arange(len(shown))
    columns = before.release.task.n_columns
    noise = generator.choice([-1.0, 1.0], size=(n, columns, 2))
    reward, spent = _replayed(before, actions, noise)
    queried = np.zeros((n, before.interface.queries.n_options), dtype=bool)
    np.put_along_axis(queried, actions[0], True, axis=1)
    parts = []
    for _ in range(trials):
        added = np.where(queried, -1.0, generator.random(queried.shape)).argmax(axis=1)
        place = generator.integers(actions[0].shape[1], size=n)
        query = actions[0].copy()
        query[every, place] = added
        swapped_reward, swapped_spent = _replayed(before, [query, *actions[1:]], noise)
        dropped = actions[0][every, place]
        gain, increase = swapped_reward - reward, swapped_spent - spent
        parts.append((every, added, dropped, gain, increase))
    state, *columns_of_swaps = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Swaps(shown, -reward / len(actions), state, *columns_of_swaps)


def _replayed(
    before: QueryProcess, actions: Sequence[Action], noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the summed reward of each episode and the budgets that its vehicles have spent then.

    Both are means over the noise and its opposite, shape (n,).
    """
    every = np.arange(before.n_episodes)
    reward, spent = np.zeros((2, before.n_episodes))
    for sign in (1.0, -1.0):
        fork = before.fork()
        fork.release.give_noise(sign * noise)
        for action in actions:
            reward += 0.5 * fork.step(every, action).reward
        spent += 0.5 * fork.release.budgets_spent(every)
    return reward, spent
