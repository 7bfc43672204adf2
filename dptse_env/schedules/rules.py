"""Rules: schedules that go by a clock, or rank segments by ages, deviations and innovations."""

from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.model.parameters import LEAST_DENSITY
from dptse_env.parts import QueryInterface
from dptse_env.process import QueryProcess
from dptse_env.schedules import ProcessSchedule, Schedule
from dptse_env.spaces.observations import AGE_CAP
from dptse_env.utils.arrays import Action, BoolArray, FloatArray, IntArray, Observation


class Nothing(Schedule):
    """No query: a lower bound, from the fixed sensors alone (mask actions only)."""

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        return np.zeros((len(step), self.queries.n_queries), dtype=bool)


class Everything(Schedule):
    """All segments at every step; ``bandwidth`` must equal the number of mainline segments.

    With the paper's mechanism more sensors mean more noise on each, so this bounds coverage, not
    accuracy.
    """

    def __init__(self, interface: QueryInterface, seed: int | None = None) -> None:
        """Bind the schedule.

        Raises:
            ValueError: The bandwidth does not cover the road, or single segments cannot be queried.
        """
        super().__init__(interface, seed)
        queries = self.queries
        self._all = queries.span == 1
        if not self._all.any():
            raise ValueError(f"schedule 'all' needs query_spans with 1, got {queries}")
        if self.bandwidth < self.n_mainline:
            raise ValueError(
                f"schedule 'all' needs bandwidth {self.n_mainline}, the environment has "
                f"{self.bandwidth}"
            )

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        return np.tile(self._all, (len(step), 1))


class Shifting(Schedule):
    """An evenly spread set that moves one segment downstream every ``period`` steps.

    The set starts at floor(n i / B) for i = 0 .. B-1; segments beyond the downstream end continue
    upstream.

    Among several spans it keeps to the smallest one: n is the number of its queries, and B how many
    of them the bandwidth pays for.
    """

    period: ClassVar[int]

    def __init__(self, interface: QueryInterface, seed: int | None = None) -> None:
        """Bind the schedule."""
        super().__init__(interface, seed)
        queries = self.queries
        own = queries.span == queries.span.min()
        self._queries = np.flatnonzero(own)
        n = self._queries.size
        size = min(self.bandwidth // int(queries.cost[own][0]), n)
        self._start = np.arange(size) * n // size

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        place = (self._start + step[:, None] // self.period) % self._queries.size
        chosen = self.mask(self._queries[place])
        # What is left of the bandwidth goes to the first of the others.
        return self.first_that_fit(np.argsort(~chosen, axis=1, kind="stable"))


class Static(Shifting):
    """An evenly spread set that stays, see `Shifting`."""

    period = np.iinfo(np.int64).max


class ShiftAhead(Shifting):
    """The schedule of Vishnoi et al. (section IV-A): a set that moves every four steps."""

    period = 4


class RoundRobin(Shifting):
    """An evenly spread set that moves at every step, see `Shifting`."""

    period = 1


class Random(Schedule):
    """A random set of queries at every step, as many as the bandwidth pays for."""

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        keys = self.generator.random((len(step), self.queries.n_queries))
        return self.first_that_fit(np.argsort(keys, axis=1))


class OldestFirst(Schedule):
    """The segments that have been unobserved for longest; ties rotate along the road.

    A segment with a fixed sensor is observed at every step, so it is queried only if bandwidth
    remains.
    """

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        return self.highest(self.block(observation, "age"), step)


class LargestVariance(Schedule):
    """The segments of the largest posterior variance, in the reward's metric.

    Scores are

        (age + 1)^a (s_rho^2 + min(s_v, c)^2)

    with the standard deviations s_rho and s_v of the observation in the reward's units and the age
    in seconds; for a reward of density or speed alone, the variance of that. Here a = 0 and c is
    infinite. The blocks of deviations are clipped at exp(-10) and exp(5), beyond which segments
    tie. A step sorts the segments once.

    Attributes:
        age_power: Exponent a.
        speed_cap: Cap c, in units of the free speed.
        term: A reward's term that takes the place of the environment's; None for that.
    """

    age_power: ClassVar[float] = 0.0
    speed_cap: ClassVar[float] = np.inf
    term: ClassVar[str | None] = None

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        n, term = self.n_mainline, self.term or self.interface.reward.term
        age, density_log, speed_log = (
            self.block(observation, name)[:, :n].astype(np.float64)
            for name in ("age", "density_log_std", "speed_log_std")
        )
        variance = np.zeros_like(age)
        if term != "speed":
            variance += np.exp(2.0 * density_log)
        if term != "density":
            variance += np.minimum(np.exp(speed_log), self.speed_cap) ** 2
        return self.highest((AGE_CAP * age + 1.0) ** self.age_power * variance, step)


class LargestDensityVariance(LargestVariance):
    """The segments of the largest variance of density, whatever the reward."""

    term = "density"


class StaleVariance(LargestVariance):
    """`LargestVariance` times the square of the time since the last measurement: a = 2, c = 0.1.

    The age compensates for an estimator that is overconfident about segments without recent
    measurements, the cap of a tenth of the free speed for one that is underconfident about speeds
    on nearly empty segments. Both were selected on validation traffic.
    """

    age_power = 2.0
    speed_cap = 0.1


class LargestDeviation(LargestVariance):
    """`LargestVariance` times the time since the last measurement: a = 1, c infinite.

    It suits estimators whose deviations are honest, such as `recurrent`.
    """

    age_power = 1.0


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
    were chosen on validation traffic of ``dptse/PrivateHighway-v1`` with ``privacy="capped"`` and
    the EKF, for which it is made: the deviations of that filter say little of where it errs. A
    step sorts the segments once.
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
        # The call below has `_choose` read those of some episodes here.
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
        squares = np.zeros((k, self.queries.n_queries))
        for name in ("density_innovation", "speed_innovation"):
            squares += 0.5 * self.block(batch, name).astype(np.float64) ** 2
        # While the picks of a second are made one by one, the same measurements are seen again.
        is_new = ~self.interface.picked(batch).any(axis=1, keepdims=True)
        answered = np.where(is_new, self.block(batch, "queried") > 0.0, False).astype(np.float64)
        covers = self.queries.covers.astype(np.float64)
        times = answered @ covers
        mean = (squares * answered) @ covers / np.maximum(times, 1.0)
        mixed: FloatArray = (1.0 - self.newest) * before + self.newest * mean
        return np.where(times > 0.0, mixed, before)

    def _choose(self, episodes: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        return self._highest_of(self._present[episodes], step, observation)

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


class ExpectedReduction(ProcessSchedule):
    """The segments whose query is expected to reduce the squared error the most, times the age.

    With the reported variances P of density and speed, and the variances V of what the release
    model expects to release about them, scores are

        (age + 1) (P_rho^2 / (P_rho + V_rho) / a^2 + P_v^2 / (P_v + V_v) / b^2)

    in units a, b of the reward, with the term that the reward has. The variance of a speed that is
    released as a flow is that of the flow's noise over the squared density. Errors of different
    segments, and of density and speed, count as independent: for estimators whose deviations are
    honest, such as `recurrent`. A step sorts the segments once.
    """

    name: ClassVar[str] = "expected-reduction"

    def __init__(self, process: QueryProcess, seed: int | None = None) -> None:
        """Bind the schedule to a process (``env.unwrapped.process``)."""
        super().__init__(process, seed)
        self._noise = np.square(process.expected_sigma)
        corridor, term = process.config.corridor, process.interface.reward.term
        self._of_density = (term != "speed") / corridor.scales.density_scale**2
        self._of_speed = (term != "density") / corridor.scales.speed_scale**2

    def _choose(self, episodes: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        n, estimate = self.n_mainline, self.process.estimate
        density, density_std, speed_std = (
            table[episodes, :n]
            for table in (estimate.density, estimate.density_std, estimate.speed_std)
        )
        flows = self.process.model.releases_flow
        carrier = np.maximum(density, LEAST_DENSITY) if flows else np.ones_like(density)
        value = self._of_density * _reduction(density_std**2, self._noise[0])
        value += self._of_speed * _reduction(speed_std**2, self._noise[1] / carrier**2)
        return self.highest((self.process.age[episodes] + 1.0) * value, step)


def _reduction(variance: FloatArray, noise: FloatArray | float) -> FloatArray:
    """Return by how much a measurement with some noise reduces a variance."""
    reduced: FloatArray = variance**2 / np.maximum(variance + noise, 1e-300)
    return reduced
