"""Query policies that need no training.

Every schedule has the ``predict`` of a stable-baselines3 policy, so one loop serves fixed and
learned policies alike. It sees only the observation. What it must remember between steps travels
in ``state``, so one schedule serves any number of episodes at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np

from dptse_env.arrays import Action, BoolArray, IntArray, Observation
from dptse_env.interface import QueryInterface


class ScheduleState(NamedTuple):
    """What a schedule carries from one step to the next.

    Attributes:
        step: Decisions completed in the episode, shape (k,).
        wanted: The segments of the decision in progress, shape (k, n_mainline).
    """

    step: IntArray
    wanted: BoolArray


class Schedule(ABC):
    """A query policy; subclasses say which segments to ask in `select`."""

    def __init__(self, interface: QueryInterface, seed: int | None = None) -> None:
        """Bind the schedule to an environment's ``interface``.

        Args:
            interface: What the environment shows and takes (``env.unwrapped.interface``).
            seed: Seed of the schedule's own choices, for those that draw any.
        """
        self.interface = interface
        self.n_mainline = interface.n_mainline
        self.bandwidth = interface.bandwidth
        self.generator = np.random.default_rng(seed)

    @abstractmethod
    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """Return the segments to query, shape (k, n_mainline).

        Args:
            step: Decisions completed so far in each episode, shape (k,).
            observation: Observations, shape (k, size).
        """

    def predict(
        self,
        observation: Observation,
        state: tuple[Any, ...] | None = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Action, tuple[Any, ...]]:
        """Return the actions for one observation or a batch of them, and the new state.

        Args:
            observation: Shape (size,) or (k, size).
            state: The state returned by the last call, None at the first.
            episode_start: Which episodes have just begun, shape (k,) or a single flag.
            deterministic: Accepted for the sake of the common signature. A schedule does the
                same either way; the random one draws in both cases.
        """
        del deterministic
        batch = np.atleast_2d(observation)
        k = len(batch)
        step, wanted = self._resume(k, state, episode_start)
        picked = self._picked(batch)
        fresh = ~picked.any(axis=1)
        if fresh.any():
            wanted[fresh] = self.select(step[fresh], batch[fresh])
        action = self.interface.actions.encode(wanted, picked)
        last_pick = picked.sum(axis=1) + 1 == self.interface.actions.actions_per_step
        new_state = ScheduleState(step + last_pick, wanted)
        return (action[0] if np.ndim(observation) == 1 else action), new_state

    def _resume(
        self, k: int, state: tuple[Any, ...] | None, episode_start: Any
    ) -> tuple[IntArray, BoolArray]:
        if state is None:
            step = np.zeros(k, dtype=np.int64)
            wanted = np.zeros((k, self.n_mainline), dtype=bool)
        else:
            step, wanted = np.array(state[0]), np.array(state[1])
        if episode_start is not None:
            step[np.broadcast_to(episode_start, (k,)).astype(bool)] = 0
        return step, wanted

    def _picked(self, batch: Observation) -> BoolArray:
        if "picked" not in self.interface.observations.slices:
            return np.zeros((len(batch), self.n_mainline), dtype=bool)
        return self.interface.observations.block(batch, "picked") > 0

    def _block(self, observation: Observation, name: str) -> Observation:
        return self.interface.observations.block(observation, name)

    def _mask(self, chosen: IntArray) -> BoolArray:
        """Return the mask of the chosen indices, (k, anything) to (k, n_mainline)."""
        mask = np.zeros((len(chosen), self.n_mainline), dtype=bool)
        np.put_along_axis(mask, chosen, True, axis=1)
        return mask


class Shifting(Schedule):
    """An evenly spread set that moves one segment downstream every ``period`` steps.

    The set starts at floor(n i / B) for i = 0 .. B-1; what leaves the road downstream comes back
    upstream. ``period=4`` is the schedule of Vishnoi et al. (section IV-A), ``period=1`` a round
    robin, ``period=None`` a static set.
    """

    def __init__(
        self, interface: QueryInterface, seed: int | None = None, *, period: int | None = 4
    ) -> None:
        """Bind the schedule; ``period`` [steps] must be None or at least 1."""
        super().__init__(interface, seed)
        if period is not None and period < 1:
            raise ValueError(f"schedule.period must be None or >= 1, got {period}")
        self.period = period
        self._start = np.arange(self.bandwidth) * self.n_mainline // self.bandwidth

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        shift = np.zeros_like(step) if self.period is None else step // self.period
        return self._mask((self._start + shift[:, None]) % self.n_mainline)


class Random(Schedule):
    """``bandwidth`` different segments, drawn anew at every step."""

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        keys = self.generator.random((len(step), self.n_mainline))
        return self._mask(np.argsort(keys, axis=1)[:, : self.bandwidth])


class OldestFirst(Schedule):
    """The segments that have not been observed for longest; ties go round the road.

    A segment with a fixed sensor is observed at every step and so is never asked, unless there
    is bandwidth to spare.
    """

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        age = self._block(observation, "age")
        # Always breaking ties from one end would ask the segments there half as often again.
        turn = (np.arange(self.n_mainline) - step[:, None]) % self.n_mainline
        return self._mask(np.lexsort((turn, -age), axis=1)[:, : self.bandwidth])


class Nothing(Schedule):
    """No query at all: the fixed sensors alone. A lower mark (mask actions only)."""

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        return np.zeros((len(step), self.n_mainline), dtype=bool)


class Everything(Schedule):
    """Every segment at every step. An upper mark: it needs ``bandwidth`` equal to the road.

    With the paper's mechanism more sensors mean more noise on each, so this is the upper mark of
    coverage, not of accuracy.
    """

    def __init__(self, interface: QueryInterface, seed: int | None = None) -> None:
        """Bind the schedule.

        Raises:
            ValueError: The bandwidth does not cover the road.
        """
        super().__init__(interface, seed)
        if self.bandwidth < self.n_mainline:
            raise ValueError(
                f"schedule 'all' needs bandwidth {self.n_mainline}, the environment has "
                f"{self.bandwidth}"
            )

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        return np.ones((len(step), self.n_mainline), dtype=bool)


def _static(interface: QueryInterface, seed: int | None = None) -> Schedule:
    return Shifting(interface, seed, period=None)


def _paper(interface: QueryInterface, seed: int | None = None) -> Schedule:
    return Shifting(interface, seed, period=4)


def _round_robin(interface: QueryInterface, seed: int | None = None) -> Schedule:
    return Shifting(interface, seed, period=1)


SCHEDULES = {
    "none": Nothing,
    "static": _static,
    "paper": _paper,
    "round-robin": _round_robin,
    "random": Random,
    "oldest-first": OldestFirst,
    "all": Everything,
}


def make_schedule(name: str, env: Any, seed: int | None = None) -> Schedule:
    """Return the schedule ``name`` for an environment.

    Args:
        name: A name in `SCHEDULES`.
        env: An environment of this package, wrapped or not.
        seed: Seed of the schedule's own choices.

    Raises:
        ValueError: The name is unknown or the schedule does not suit the environment.
    """
    if name not in SCHEDULES:
        raise ValueError(f"unknown schedule {name!r}; known: {', '.join(SCHEDULES)}")
    return SCHEDULES[name](env.unwrapped.interface, seed)
