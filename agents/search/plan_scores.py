"""Score open-loop query plans on training traffic, all on the same traffic and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.engines.engine import Workers
from agents.environments import given_keywords, make_vector
from agents.evaluation.episodes import WARM_UP
from dptse_env.config import TRAINING_SEEDS, parse_seeds
from dptse_env.schedules import PLANS
from dptse_env.traffic import Records
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import integer
from dptse_env.vector_env import SensorQueryVectorEnv

FIRST_SEEDS = 4
"""Traffic seeds of the first comparison with a neighbour."""


@dataclass(frozen=True)
class PlanTask:
    """The plan that is searched for, and the traffic it is searched on.

    Attributes:
        env: Environment id.
        kind: Kind of plan: 'optimised-plan', a period of sets, or 'best-static', one set.
        period: Sets in the period; 1 for a static set.
        estimator: State estimator.
        parameters: Name of the ARZ parameters; the environment's own if not given.
        bandwidth: Segments to query a second; the environment's own if not given.
        seeds: Traffic seeds, first:stop; training seeds only.
        neighbours: Neighbours of the best plan that a round tries; twice as many random plans
            begin the search, and four times as many episodes run at once.
        seed: Seeds the search.
        corridor: Road in place of the environment's: the name of a shipped corridor, a road file
            that ends in .toml, or a JSON object of corridor fields.
    """

    env: str = "dptse_env:dptse/PrivateHighway-v0"
    kind: str = "optimised-plan"
    period: int = 12
    estimator: str = "ekf"
    parameters: str | None = None
    bandwidth: int | None = None
    seeds: str = "0:64"
    neighbours: int = 31
    seed: int = 0
    corridor: str | None = None

    def check(self) -> None:
        """Check what needs no environment.

        Raises:
            ValueError: A value is out of range.
        """
        if self.kind not in PLANS:
            raise ValueError(f"kind must be one of {', '.join(PLANS)}, got {self.kind!r}")
        integer("period", self.period, 1)
        if self.kind == "best-static" and self.period != 1:
            raise ValueError(f"period must be 1 for a static set, got {self.period}")
        if not set(self.traffic_seeds) <= set(TRAINING_SEEDS):
            raise ValueError(f"seeds must be training seeds, below 1000, got {self.seeds!r}")
        integer("neighbours", self.neighbours, 3)
        if len(self.traffic_seeds) < FIRST_SEEDS:
            raise ValueError(f"seeds must be {FIRST_SEEDS} or more, got {self.seeds!r}")

    @property
    def traffic_seeds(self) -> tuple[int, ...]:
        """The traffic seeds one by one."""
        return parse_seeds(self.seeds)

    @property
    def batch(self) -> int:
        """Episodes that run at once."""
        return FIRST_SEEDS * (self.neighbours + 1)

    def make(
        self, n_episodes: int, seeds: tuple[int, ...], records: Records = None
    ) -> SensorQueryVectorEnv:
        """Make the environment for a number of episodes on some traffic seeds."""
        keywords = given_keywords("{}", self.corridor)
        keywords |= {"estimator": self.estimator, "records": records}
        for name in ("parameters", "bandwidth"):
            if getattr(self, name) is not None:
                keywords[name] = getattr(self, name)
        more = {"traffic_seeds": seeds, "action": "mask", "threads": 1}
        return make_vector(self.env, n_episodes, {**keywords, **more})


class PlanScorer:
    """Scores plans on the same traffic and noise, a batch of plans at a time.

    Attributes:
        env: The vector environment.
        free: Mainline segments without a fixed sensor, shape (A,).
    """

    def __init__(
        self,
        task: PlanTask,
        seeds: tuple[int, ...],
        n_episodes: int,
        *,
        records: Records = None,
        workers: Workers | None = None,
    ) -> None:
        """Make the environment; nothing is recorded before `scores`.

        Args:
            task: What is searched for.
            seeds: Traffic seeds that may be asked for.
            n_episodes: Episodes that run at once.
            records: Library of records, or its folder; None for the user's cache.
            workers: Share the plans of a call of `scores`; None for this process alone.

        Raises:
            ValueError: A value of the task is out of range, or queries are not of single segments.
        """
        task.check()
        self.env = task.make(n_episodes, seeds, records)
        self.n_episodes = n_episodes
        self._task, self._seeds, self._records = task, seeds, records
        self._workers = workers
        config = self.env.config
        if not config.queries.are_plain:
            raise ValueError(
                f"plans are of single segments: they need query_spans (1,) and price_levels "
                f"(1.0,), got {config.queries}"
            )
        self.n_mainline, self.bandwidth = config.corridor.n_mainline, config.bandwidth
        self.free = np.setdiff1d(np.arange(self.n_mainline), config.corridor.fixed_sensors)
        if len(self.free) < self.bandwidth:
            raise ValueError(
                f"bandwidth {self.bandwidth} leaves nothing to choose among the "
                f"{len(self.free)} segments without a fixed sensor"
            )

    def scores(self, plans: BoolArray, seeds: IntArray, noise: int) -> FloatArray:
        """Return mean rewards of plans (m, period, n) on traffic seeds (r,), shape (m, r)."""
        if self._workers is not None:
            return self._shared(self._workers, plans, seeds, noise)
        m, r = len(plans), len(seeds)
        most = self.n_episodes // r
        if m > most:
            blocks = [plans[i : i + most] for i in range(0, m, most)]
            return np.concatenate([self.scores(block, seeds, noise) for block in blocks])
        traffic = np.resize(np.tile(seeds, m), self.n_episodes).tolist()
        followed = np.resize(np.repeat(np.arange(m), r), self.n_episodes)
        env = self.env
        env.reset(seed=[noise + seed for seed in traffic], options={"traffic_seed": traffic})
        total, n_steps = np.zeros(self.n_episodes), env.config.horizon_steps
        for step in range(n_steps):
            transition = env.advance(plans[followed, step % plans.shape[1]].astype(np.int8))
            if step >= WARM_UP:
                total += transition.reward
        mean: FloatArray = total[: m * r] / (n_steps - WARM_UP)
        return mean.reshape(m, r)

    def _shared(
        self, workers: Workers, plans: BoolArray, seeds: IntArray, noise: int
    ) -> FloatArray:
        """Return the scores of plans, some from each worker."""
        n = min(len(plans), max(workers.capacity // 2, 1))
        blocks = [
            PlanBlock(self._task, self._seeds, self._records, block, seeds, noise)
            for block in np.array_split(plans, n)
        ]
        scored = [workers.submit(score_block, block) for block in blocks]
        return np.concatenate([future.result() for future in scored])


@dataclass(frozen=True, eq=False)
class PlanBlock:
    """Plans to score, with everything that a worker needs; see `PlanScorer.scores`."""

    task: PlanTask
    known_seeds: tuple[int, ...]
    records: Records
    plans: BoolArray
    seeds: IntArray
    noise: int


def score_block(block: PlanBlock) -> FloatArray:
    """Return the scores of some plans, shape (m, r)."""
    n = min(len(block.plans) * len(block.seeds), max(block.task.batch, len(block.seeds)))
    scorer = PlanScorer(block.task, block.known_seeds, n, records=block.records)
    return scorer.scores(block.plans, block.seeds, block.noise)
