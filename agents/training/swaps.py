"""What a swap of one queried segment for another gains, measured on twins of an episode.

Two twins begin in the same second with the same estimator and the same traffic. They ask the same
but for one segment of their first query, and the same from then on, so what their errors differ by
in the coming seconds comes from that swap alone. The policy is not asked again after a swap: near
an optimum, what it would do differently then is worth little.

Noise would drown the difference. In the first query it is therefore plus or minus sigma, which has
the moments of the Gaussian up to the third, and every trial is run with either sign, which takes
away all that is odd in it; in later seconds it is the noise that comes. A swap's gain scatters by a
third of what it does with Gaussian noise of one sign.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from agents.evaluation.episodes import WARM_UP, Policy
from dptse_env.arrays import Action, AnyArray, FloatArray, IntArray, Observation
from dptse_env.privacy import Mechanism
from dptse_env.process import QueryProcess
from dptse_env.vector_env import SensorQueryVectorEnv


@dataclass(frozen=True)
class Swaps:
    """Swaps that were tried, k of them in m states.

    Attributes:
        observations: Of the states, shape (m, size).
        error: Mean error of a second in the seconds that follow a state, minus the reward, (m,).
        state: In which state each swap was tried, shape (k,).
        added: Segment that was asked, shape (k,).
        dropped: Segment that was not asked in its place, shape (k,).
        gain: By how much less the estimate erred in these seconds, summed, shape (k,).
        exposures: By how much more often vehicles counted in them, shape (k,); zero where
            vehicles count without bound.
    """

    observations: Observation
    error: FloatArray
    state: IntArray
    added: IntArray
    dropped: IntArray
    gain: FloatArray
    exposures: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Swaps]) -> Swaps:
        """Return the swaps of all parts."""

        def all_of(name: str) -> AnyArray:
            return np.concatenate([getattr(part, name) for part in parts])

        first = np.cumsum([0] + [len(part.observations) for part in parts[:-1]])
        return cls(
            all_of("observations"),
            all_of("error"),
            np.concatenate([n + part.state for n, part in zip(first, parts, strict=True)]),
            *(all_of(name) for name in ("added", "dropped", "gain", "exposures")),
        )


class FirstNoise:
    """A mechanism whose next release has a given noise; later ones are those of another."""

    def __init__(self, mechanism: Mechanism, noise: FloatArray) -> None:
        """Take over from ``mechanism``; ``noise`` has the shape of a release."""
        self._mechanism, self._noise = mechanism, noise
        self._is_first = True

    @property
    def sigma(self) -> FloatArray:
        """See `Mechanism`."""
        return self._mechanism.sigma

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `Mechanism`; episodes begin with noise of their own."""
        self._is_first = False
        self._mechanism.reset(episodes, generators)

    def release(self, episodes: IntArray, values: FloatArray) -> FloatArray:
        """See `Mechanism`."""
        released = self._mechanism.release(episodes, values)  # its streams move on in any case
        if not self._is_first:
            return released
        self._is_first = False
        return values + self._noise


def try_swaps(
    env: SensorQueryVectorEnv,
    policy: Policy,
    seeds: Sequence[int],
    generator: np.random.Generator,
    *,
    seconds: int,
    trials: int,
) -> Iterator[Swaps]:
    """Run an episode of ``policy`` for each seed, and try swaps all along.

    Args:
        env: One episode for each seed, actions ``slots``, autoreset disabled.
        policy: Acts by drawing.
        seeds: Of the episodes, n of them.
        generator: Draws the swaps, one of the queried for one of the other segments, and signs.
        seconds: For how many seconds twins are followed, and how many lie between two states.
        trials: Swaps in each state.

    Yields:
        The swaps of n states, of one second of all episodes.

    Raises:
        ValueError: All segments are queried, so that there is nothing to swap, or episodes end
            before a twin could be followed.
    """
    horizon, n = env.config.horizon_steps, env.interface.n_mainline
    if env.config.bandwidth >= n:
        raise ValueError(f"swaps need a bandwidth below {n} segments, got {env.config.bandwidth}")
    # States fall on other seconds in every pass.
    first = min(WARM_UP, horizon // 4) + int(generator.integers(seconds))
    if first + seconds > horizon:
        raise ValueError(
            f"swaps need a horizon that leaves {seconds} s to follow twins, got {horizon} s"
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
    return policy.predict(observation, deterministic=False)[0]


def _tried(
    before: QueryProcess,
    shown: Observation,
    actions: Sequence[Action],
    generator: np.random.Generator,
    trials: int,
) -> Swaps:
    """Try swaps in the first of ``actions``, in every episode of ``before``."""
    n, every = len(shown), np.arange(len(shown))
    columns = before.config.corridor.n_segments + before.boundary.n_released
    noise = generator.choice([-1.0, 1.0], size=(n, columns, 2)) * before.mechanism.sigma
    reward, exposures = _followed(before, actions, noise)
    asked = np.zeros((n, before.interface.n_mainline), dtype=bool)
    np.put_along_axis(asked, actions[0], True, axis=1)
    parts = []
    for _ in range(trials):
        added = np.where(asked, -1.0, generator.random(asked.shape)).argmax(axis=1)
        place = generator.integers(actions[0].shape[1], size=n)
        query = actions[0].copy()
        query[every, place] = added
        swapped_reward, swapped_exposures = _followed(before, [query, *actions[1:]], noise)
        dropped = actions[0][every, place]
        gain, more = swapped_reward - reward, swapped_exposures - exposures
        parts.append((every, added, dropped, gain, more))
    state, *rest = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Swaps(shown, -reward / len(actions), state, *rest)


def _followed(
    before: QueryProcess, actions: Sequence[Action], noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the summed reward of each episode and how often its vehicles have counted by then.

    Both are means over the noise and its opposite, shape (n,).
    """
    every = np.arange(before.n_episodes)
    reward, exposures = np.zeros((2, before.n_episodes))
    for sign in (1.0, -1.0):
        fork = before.fork()
        fork.mechanism = FirstNoise(fork.mechanism, sign * noise)
        for action in actions:
            reward += 0.5 * fork.step(every, action).reward
        counted = fork.answers.contributions
        if counted is not None:
            exposures += 0.5 * counted.exposures.sum(axis=1)
    return reward, exposures
