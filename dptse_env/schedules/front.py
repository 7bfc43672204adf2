"""A schedule on the fronts of the estimated speed, and on how much past answers surprised."""

from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.schedules.base import Schedule
from dptse_env.spaces.observations import AGE_CAP
from dptse_env.utils.arrays import Action, BoolArray, FloatArray, IntArray, Observation


class FrontState(NamedTuple):
    """State of `SpeedFront` between steps; the first two are those of `ScheduleState`.

    Attributes:
        surprise: Running mean of squared innovations, shape (k, n_mainline).
    """

    step: IntArray
    wanted: BoolArray
    surprise: FloatArray


class SpeedFront(Schedule):
    """The segments where the estimated speed changes along the road and answers surprised.

    Scores are

        (age + 1)^1.5 (|v_before - v_after| + 0.02) q (v + 0.3) (2 - x)

    with the estimated speeds v of the segment and of its neighbours in units of the reward, the
    place x from 0 upstream to 1 downstream, and q the mean of the squared normalised innovations of
    density and speed, averaged over measurements: a new one counts a fifth. Exponent and constants
    were chosen on validation traffic of ``dptse/PrivateHighway-v0`` with the EKF, for which it is
    made: the deviations of that filter say little of where it errs. A step
    sorts the segments once.
    """

    age_power: ClassVar[float] = 1.5
    least_front: ClassVar[float] = 0.02
    least_speed: ClassVar[float] = 0.3
    newest: ClassVar[float] = 0.2

    def predict(
        self,
        observation: Observation,
        state: tuple[Any, ...] | None = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Action, tuple[Any, ...]]:
        """See `Schedule.predict`; the state is a `FrontState`."""
        batch = np.atleast_2d(observation)
        surprise = self._surprise(batch, state, episode_start)
        # `_choose` is called with some rows of the batch in the call below, and reads theirs here.
        self._present = surprise
        action, (step, wanted) = super().predict(
            observation, None if state is None else state[:2], episode_start, deterministic
        )
        return action, FrontState(step, wanted, surprise)

    def _surprise(
        self, batch: Observation, state: tuple[Any, ...] | None, episode_start: Any
    ) -> FloatArray:
        """Return the running means with the last measurements in them."""
        k, n = len(batch), self.n_mainline
        before = np.ones((k, n)) if state is None else np.array(state[2])
        if episode_start is not None:
            before[np.broadcast_to(episode_start, (k,)).astype(bool)] = 1.0
        squares = np.zeros((k, self.queries.n_options))
        for name in ("density_innovation", "speed_innovation"):
            squares += 0.5 * self.block(batch, name).astype(np.float64) ** 2
        # While the picks of a second are made one by one, the same measurements are seen again.
        is_new = ~self._picked(batch).any(axis=1, keepdims=True)
        answered = np.where(is_new, self.block(batch, "queried") > 0.0, False).astype(np.float64)
        covers = self.queries.covers.astype(np.float64)
        times = answered @ covers
        mean = (squares * answered) @ covers / np.maximum(times, 1.0)
        mixed: FloatArray = (1.0 - self.newest) * before + self.newest * mean
        return np.where(times > 0.0, mixed, before)

    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        return self._highest_of(self._present[rows], step, observation)

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`; as if no answer had surprised yet."""
        return self._highest_of(np.ones((len(step), self.n_mainline)), step, observation)

    def _highest_of(
        self, surprise: FloatArray, step: IntArray, observation: Observation
    ) -> BoolArray:
        n = self.n_mainline
        age, speed = (
            self.block(observation, name)[:, :n].astype(np.float64) for name in ("age", "speed")
        )
        before = np.concatenate([speed[:, :1], speed[:, :-1]], axis=1)
        after = np.concatenate([speed[:, 1:], speed[:, -1:]], axis=1)
        value = (AGE_CAP * age + 1.0) ** self.age_power * surprise
        value *= (np.abs(before - after) + self.least_front) * (speed + self.least_speed)
        return self.highest(value * np.linspace(2.0, 1.0, n), step)
