"""Query schedules: policies without training, and oracles.

Every schedule has the ``predict`` of a stable-baselines3 policy, so one loop serves schedules and
learned policies alike. Its memory between steps travels in ``state``, so one schedule serves any
number of episodes at once.
"""

from abc import ABC, abstractmethod
from inspect import signature
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.parts import QueryInterface
from dptse_env.process import QueryProcess
from dptse_env.release import Queries
from dptse_env.spaces.actions import first_that_fit
from dptse_env.utils.arrays import Action, BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.registry import Registry

OBSERVATION_SCHEDULES = {
    "none": "dptse_env.schedules.rules:Nothing",
    "static": "dptse_env.schedules.rules:Static",
    "shift-ahead": "dptse_env.schedules.rules:ShiftAhead",
    "round-robin": "dptse_env.schedules.rules:RoundRobin",
    "random": "dptse_env.schedules.rules:Random",
    "oldest-first": "dptse_env.schedules.rules:OldestFirst",
    "largest-variance": "dptse_env.schedules.rules:LargestVariance",
    "largest-density-variance": "dptse_env.schedules.rules:LargestDensityVariance",
    "stale-variance": "dptse_env.schedules.rules:StaleVariance",
    "largest-deviation": "dptse_env.schedules.rules:LargestDeviation",
    "speed-front": "dptse_env.schedules.rules:SpeedFront",
    "all": "dptse_env.schedules.rules:Everything",
}
"""Schedules that use the observation alone; a step costs at most a sort."""

PROCESS_SCHEDULES = {
    "expected-reduction": "dptse_env.schedules.rules:ExpectedReduction",
    "greedy-trace": "dptse_env.schedules.greedy:GreedyTrace",
}
"""Schedules that use the process, but not the truth: the noise to expect, and the estimator's
deviations or covariance. A step costs a sort, or some two steps of the EKF."""

ORACLES = {
    "oracle-error": "dptse_env.schedules.oracles:OracleError",
    "oracle-gain": "dptse_env.schedules.oracles:OracleGain",
}
"""Bounds that use the truth; they are not policies."""


def _expected(part: Any) -> str | None:
    acts = callable(part) and not isinstance(part, type)
    if not acts and not callable(getattr(part, "predict", None)):
        return "have predict(), or be a function of an observation"
    return None


SCHEDULES = Registry(
    "schedule", {**OBSERVATION_SCHEDULES, **PROCESS_SCHEDULES, **ORACLES}, check=_expected
)
"""All schedules by name."""


def make_schedule(schedule: Any, env: Any, seed: int | None = None) -> Any:
    """Return a policy with the ``predict`` of stable-baselines3, for an environment.

    Args:
        schedule: A name in `SCHEDULES`, ``"package.module:Name"``, a class, an object with
            ``predict``, or a function. A class other than a `Schedule` is called with the bare
            environment, or without arguments if it takes none. A function, and a ``predict`` of
            fewer arguments, are called with the observation, (size,) or (k, size), and return the
            action, (...) or (k, ...), or a tuple that begins with it.
        env: An environment of this package, scalar or vector, wrapped or not.
        seed: Seed of the schedule's random choices.

    Raises:
        ValueError: The name is unknown or the schedule does not suit the environment.
    """
    part, bare = SCHEDULES.find(schedule), env.unwrapped
    policy: Any = part
    if isinstance(part, type):
        if issubclass(part, Schedule):
            needs_process = issubclass(part, ProcessSchedule)
            policy = part(bare.process if needs_process else bare.interface, seed)
        else:
            make: Any = part
            policy = make(bare) if signature(make).parameters else make()
    return policy if _remembers(policy) else Memoryless(policy)


def _remembers(policy: Any) -> bool:
    """Return whether a policy has a ``predict`` of observation, state, start and mode."""
    try:
        signature(policy.predict).bind(None, None, None, True)
    except (AttributeError, TypeError):
        return False
    return True


class Memoryless:
    """A policy made of a function of the observation, or of a ``predict`` that takes little more.

    A ``predict`` with an argument ``deterministic`` is given it.
    """

    def __init__(self, policy: Any) -> None:
        """Take a function, or an object with ``predict``."""
        self._act = getattr(policy, "predict", policy)
        self._names_mode = "deterministic" in signature(self._act).parameters

    def predict(
        self,
        observation: Observation,
        state: None = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Action, None]:
        """Return the actions for one observation (size,) or a batch (k, size)."""
        mode = {"deterministic": deterministic} if self._names_mode else {}
        found = self._act(observation, **mode)
        return np.asarray(found[0] if isinstance(found, tuple) else found), None


class ScheduleState(NamedTuple):
    """State of a schedule between steps.

    Attributes:
        step: Decisions completed in the episode, shape (k,).
        wanted: The queries of the decision in progress, shape (k, G).
    """

    step: IntArray
    wanted: BoolArray


class Schedule(ABC):
    """A query policy that needs no training; subclasses choose queries in `select`.

    Queries are the mainline segments, unless the environment has other spans
    (`dptse_env.release.Queries`).

    Attributes:
        queries: The G options.
        n_mainline: Mainline segments.
        bandwidth: Largest total cost of the queries of a step.
        uses_truth: Whether the choice depends on the true traffic. Such a schedule is a bound on
            policies, not a policy.
    """

    uses_truth: ClassVar[bool] = False

    def __init__(self, interface: QueryInterface, seed: int | None = None) -> None:
        """Bind the schedule to an environment's interface (``env.unwrapped.interface``)."""
        self.interface = interface
        self.queries = interface.queries
        self.n_mainline = self.queries.n_mainline
        self.bandwidth = self.queries.bandwidth
        self.generator = np.random.default_rng(seed)

    @abstractmethod
    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """Return the chosen queries, shape (k, G).

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
        picked = self.interface.picked(batch)
        fresh = np.flatnonzero(~picked.any(axis=1))
        if fresh.size:
            wanted[fresh] = self._choose(fresh, step[fresh], batch[fresh])
        action = self.interface.actions.encode(wanted, picked)
        last_pick = self.interface.actions.completes(wanted, picked)
        new_state = ScheduleState(step + last_pick, wanted)
        return (action[0] if np.ndim(observation) == 1 else action), new_state

    def _choose(self, episodes: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        """Return `select` for some ``episodes`` of the batch; all arrays have these alone."""
        del episodes
        return self.select(step, observation)

    def _resume(
        self, k: int, state: tuple[Any, ...] | None, episode_start: Any
    ) -> tuple[IntArray, BoolArray]:
        if state is None:
            step = np.zeros(k, dtype=np.int64)
            wanted = np.zeros((k, self.queries.n_queries), dtype=bool)
        else:
            step, wanted = np.array(state[0]), np.array(state[1])
        if episode_start is not None:
            step[np.broadcast_to(episode_start, (k,)).astype(bool)] = 0
        return step, wanted

    def block(self, observation: Observation, name: str) -> Observation:
        """Return a block of observations (k, size), shape (k, size of the block)."""
        return self.interface.observations.block(observation, name)

    def mask(self, chosen: IntArray) -> BoolArray:
        """Return flags (k, G) of the chosen queries, given their indices (k, m) for any m."""
        mask = np.zeros((len(chosen), self.queries.n_queries), dtype=bool)
        np.put_along_axis(mask, chosen, True, axis=1)
        return mask

    def first_that_fit(self, order: IntArray) -> BoolArray:
        """Return the mask of the first queries of an order (k, G) that the bandwidth pays for.

        A query that costs more than is left is passed over.
        """
        return first_that_fit(order, self.queries.cost, self.bandwidth)

    def highest(self, value: FloatArray | Observation, step: IntArray) -> BoolArray:
        """Return the queries of the highest value that the bandwidth pays for, shape (k, G).

        Ties rotate along the road with the step: breaking them from one end would query the
        segments there 1.5 times as often. A mainline segment with a fixed sensor is observed
        without a query, so it comes last for any value.

        Other queries are chosen as `best_queries` says.

        Args:
            value: Value of each mainline segment, shape (k, n_mainline); none below 0 where costs
                differ.
            step: Decisions completed so far, shape (k,).
        """
        task = self.interface.observations.task
        fixed = task.channels.first[task.sensors]
        fixed = fixed[fixed < self.n_mainline]
        score = np.array(value, dtype=np.float64)
        if self.queries.are_segments:
            score[:, fixed] = -np.inf
            turn = (np.arange(self.n_mainline) - step[:, None]) % self.n_mainline
            return self.first_that_fit(np.lexsort((turn, -score), axis=1))
        return best_queries(self.queries, score, fixed, step)


def require_plain(interface: QueryInterface, name: str) -> None:
    """Refuse queries other than the mainline segments.

    Raises:
        ValueError: There are others; ``name`` is the schedule's.
    """
    if not interface.queries.are_segments:
        raise ValueError(
            f"schedule {name!r} queries single segments: it needs query_spans (1,), got "
            f"{interface.queries}"
        )


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
    def _choose(
        self, episodes: IntArray, step: IntArray, observation: Observation
    ) -> BoolArray: ...


def best_queries(queries: Queries, value: FloatArray, fixed: IntArray, step: IntArray) -> BoolArray:
    """Return the queries of the highest `query_values` that the bandwidth pays for, shape (k, G).

    They do not overlap. Where bandwidth is left that pays for no such query, it is used for
    others. Ties rotate along the road with the step.

    Args:
        queries: The G options.
        value: Value of each mainline segment, shape (k, n_mainline).
        fixed: Mainline segments with a fixed sensor.
        step: Steps of the episode so far, shape (k,).
    """
    score = query_values(queries, value, fixed)
    turn = (queries.first - step[:, None]) % queries.n_mainline
    order = np.lexsort((turn, -score), axis=1)
    chosen, every = np.zeros(score.shape, dtype=bool), np.arange(len(score))
    left = np.full(len(score), queries.bandwidth)
    covered = np.zeros((len(score), queries.n_mainline), dtype=bool)
    for is_distinct in (True, False):
        for query in order.T:
            if (left < queries.cost.min()).all():
                return chosen
            fits = (queries.cost[query] <= left) & ~chosen[every, query]
            if is_distinct:
                fits &= ~(covered & queries.covers[query]).any(axis=1)
            chosen[every, query] |= fits
            covered |= queries.covers[query] & fits[:, None]
            left -= np.where(fits, queries.cost[query], 0)
    return chosen


def query_values(queries: Queries, value: FloatArray, fixed: IntArray) -> FloatArray:
    """Return the mean values of the queries' segments, shape (k, G), per unit of cost.

    A segment with a fixed sensor counts as the least of the others; a query of such segments
    alone has minus infinity.
    """
    free = np.delete(np.arange(queries.n_mainline), fixed)
    known = np.array(value, dtype=np.float64)
    if free.size:
        known[:, fixed] = known[:, free].min(axis=1, keepdims=True)
    mean = known @ queries.covers.T / queries.span
    mean[:, ~queries.covers[:, free].any(axis=1)] = -np.inf
    return mean / queries.cost if queries.costs_differ else mean
