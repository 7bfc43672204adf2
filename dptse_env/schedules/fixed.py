"""Schedules that use a clock, or the ages and variances in the observation."""

from typing import ClassVar

import numpy as np

from dptse_env.parts import QueryInterface
from dptse_env.schedules.base import Schedule
from dptse_env.spaces.observations import AGE_CAP
from dptse_env.utils.arrays import BoolArray, IntArray, Observation


class Shifting(Schedule):
    """An evenly spread set that moves one segment downstream every ``period`` steps.

    The set starts at floor(n i / B) for i = 0 .. B-1; segments beyond the downstream end continue
    upstream. ``period=4`` is the schedule of Vishnoi et al. (section IV-A), ``period=1`` a round
    robin, ``period=None`` a static set.

    Among several spans and price levels it keeps to the smallest span and the level nearest to 1:
    n is the number of these options, and B how many of them the bandwidth pays for.
    """

    def __init__(
        self, interface: QueryInterface, seed: int | None = None, *, period: int | None = 4
    ) -> None:
        """Bind the schedule; ``period`` [steps] must be None or at least 1."""
        super().__init__(interface, seed)
        if period is not None and period < 1:
            raise ValueError(f"schedule.period must be None or >= 1, got {period}")
        self.period = period
        queries = self.queries
        own = (queries.span == queries.span.min()) & (queries.level == queries.standard_level)
        self._options = np.flatnonzero(own)
        n = self._options.size
        size = min(self.bandwidth // int(queries.cost[own][0]), n)
        self._start = np.arange(size) * n // size

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        shift = np.zeros_like(step) if self.period is None else step // self.period
        place = (self._start + shift[:, None]) % self._options.size
        return self.completed(self._options[place])


class Random(Schedule):
    """A random set of options at every step, as many as the bandwidth pays for."""

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        keys = self.generator.random((len(step), self.queries.n_options))
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
    """The segments of the largest posterior variance in the reward's metric.

    With the standard deviations s_rho and s_v of the observation, in the reward's units, it is
    s_rho^2 + s_v^2, or one of the two for a reward, or a ``term``, of density or speed alone. The
    blocks are clipped at exp(-10) and exp(5), beyond which segments tie. A step sorts the
    segments once.
    """

    def __init__(
        self, interface: QueryInterface, seed: int | None = None, *, term: str | None = None
    ) -> None:
        """Bind the schedule; a ``term`` of None is that of the reward."""
        super().__init__(interface, seed)
        term = interface.reward.term if term is None else term
        if term not in _BLOCKS:
            raise ValueError(f"schedule.term must be one of {', '.join(_BLOCKS)}, got {term!r}")
        self._names = _BLOCKS[term]

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        n = self.n_mainline
        logs = np.stack([self.block(observation, name)[:, :n] for name in self._names])
        return self.highest(np.exp(2.0 * logs.astype(np.float64)).sum(axis=0), step)


_BLOCKS = {
    "joint": ("density_log_std", "speed_log_std"),
    "density": ("density_log_std",),
    "speed": ("speed_log_std",),
}


class StaleVariance(Schedule):
    """The segments of the largest variance times the square of the time since the last measurement.

    Scores are ``(age + 1)^2 (s_rho^2 + min(s_v, 0.1)^2)`` with the age in seconds and deviations in
    the reward's units; for a reward of one term, that term alone. The age compensates for an
    estimator that is overconfident about segments without recent measurements, the cap of a tenth
    of the free speed for one that is underconfident about speeds on nearly empty segments. Both
    were selected on validation traffic. A step sorts the segments once.
    """

    age_power: ClassVar[float] = 2.0
    speed_cap: ClassVar[float] = 0.1

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        n, term = self.n_mainline, self.interface.reward.term
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


class LargestDeviation(StaleVariance):
    """The segments of the largest deviation times the square root of the time without measurement.

    Scores are ``(age + 1) (s_rho^2 + s_v^2)``, as those of `StaleVariance`, for estimators whose
    deviations are honest, such as `recurrent`.
    """

    age_power: ClassVar[float] = 1.0
    speed_cap: ClassVar[float] = np.inf


class Nothing(Schedule):
    """No query: a lower bound, from the fixed sensors alone (mask actions only)."""

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        return np.zeros((len(step), self.queries.n_options), dtype=bool)


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
        self._all = (queries.span == 1) & (queries.level == queries.standard_level)
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
