"""Base classes of schedules, whose `predict` turns chosen segments into actions."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.parts import QueryInterface
from dptse_env.process import QueryProcess
from dptse_env.utils.arrays import Action, BoolArray, FloatArray, IntArray, Observation


class ScheduleState(NamedTuple):
    """State of a schedule between steps.

    Attributes:
        step: Decisions completed in the episode, shape (k,).
        wanted: The segments of the decision in progress, shape (k, n_mainline).
    """

    step: IntArray
    wanted: BoolArray


class Schedule(ABC):
    """A query policy that needs no training; subclasses choose segments in `select`.

    Attributes:
        uses_truth: Whether the choice depends on the true traffic. Such a schedule is a bound on
            policies, not a policy.
    """

    uses_truth: ClassVar[bool] = False

    def __init__(self, interface: QueryInterface, seed: int | None = None) -> None:
        """Bind the schedule to an environment's interface (``env.unwrapped.interface``)."""
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
            episode_start: Flags of episodes that have just begun, shape (k,) or a single flag.
            deterministic: Part of the common signature, without effect.
        """
        del deterministic
        batch = np.atleast_2d(observation)
        k = len(batch)
        step, wanted = self._resume(k, state, episode_start)
        picked = self._picked(batch)
        fresh = np.flatnonzero(~picked.any(axis=1))
        if fresh.size:
            wanted[fresh] = self._choose(fresh, step[fresh], batch[fresh])
        action = self.interface.actions.encode(wanted, picked)
        last_pick = picked.sum(axis=1) + 1 == self.interface.actions.actions_per_step
        new_state = ScheduleState(step + last_pick, wanted)
        return (action[0] if np.ndim(observation) == 1 else action), new_state

    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        """Return `select` for some ``rows`` of the batch; all arrays have these rows alone."""
        del rows
        return self.select(step, observation)

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

    def block(self, observation: Observation, name: str) -> Observation:
        """Return a block of observations (k, size), shape (k, size of the block)."""
        return self.interface.observations.block(observation, name)

    def mask(self, chosen: IntArray) -> BoolArray:
        """Return the mask of the chosen indices, (k, anything) to (k, n_mainline)."""
        mask = np.zeros((len(chosen), self.n_mainline), dtype=bool)
        np.put_along_axis(mask, chosen, True, axis=1)
        return mask

    def highest(self, value: FloatArray | Observation, step: IntArray) -> BoolArray:
        """Return the ``bandwidth`` segments of the highest value (k, n_mainline).

        Ties rotate along the road with the step: breaking them from one end would query the
        segments there 1.5 times as often. A mainline segment with a fixed sensor is observed
        without a query, so it comes last for any value.
        """
        fixed = self.interface.observations.setup.fixed_sensors
        score = np.array(value, dtype=np.float64)
        score[:, fixed[fixed < self.n_mainline]] = -np.inf
        turn = (np.arange(self.n_mainline) - step[:, None]) % self.n_mainline
        return self.mask(np.lexsort((turn, -score), axis=1)[:, : self.bandwidth])


class ProcessSchedule(Schedule):
    """A schedule that uses the state of its environment's process beside the observation.

    Its batch is all episodes of that process, in order; `predict` refuses another one.
    """

    name: ClassVar[str]

    def __init__(self, process: QueryProcess, seed: int | None = None) -> None:
        """Bind the schedule to a ``process`` (``env.unwrapped.process``)."""
        super().__init__(process.interface, seed)
        self.process = process

    def _resume(
        self, k: int, state: tuple[Any, ...] | None, episode_start: Any
    ) -> tuple[IntArray, BoolArray]:
        if k != self.process.n_episodes:
            raise ValueError(
                f"schedule {self.name!r} follows the {self.process.n_episodes} episodes of its "
                f"environment, all of them and in order; got a batch of {k}"
            )
        return super()._resume(k, state, episode_start)

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`; the batch is all episodes."""
        return self._choose(np.arange(self.process.n_episodes), step, observation)

    @abstractmethod
    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray: ...
