"""Search open-loop query plans on training traffic: a static set, or a period of sets.

A plan's score is the mean reward of a second after the warm-up. Queries change neither traffic nor
noise, so plans are compared by common random numbers, many at once as episodes of one vector
environment. Every round draws fresh traffic: a plan that is good by chance does not stay the best.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import date
from importlib.metadata import version

import numpy as np

from agents.evaluation.episodes import WARM_UP
from agents.search.plan_scores import FIRST_SEEDS, PlanScorer, PlanTask
from agents.seeds import PLAN_SEARCH
from dptse_env.config import VALIDATION_SEEDS
from dptse_env.schedules import Shifting
from dptse_env.schedules.plans import Plan, PlanContext
from dptse_env.traffic import Records
from dptse_env.utils.arrays import BoolArray, IntArray

LEAST_GAIN = 1.0
"""Least gain of a neighbour that replaces the best plan [standard errors]."""
NOISE_STEP = 10_000
"""Difference of noise seeds from one round to the next."""


class PlanSearch:
    """Successive halving of random plans, then exchanges of one segment at a time.

    A round tries neighbours of the best plan so far on a few fresh seeds, the best quarter of them
    on four times as many, and the best of these on as many as the batch holds. It replaces the best
    plan if its mean gain there is `LEAST_GAIN` standard errors above zero. Rounds depend on the
    task's seed and their number alone, so an interrupted search resumes to the same result.

    Attributes:
        best: The best plan so far, shape (period, n).
        n_adopted: Neighbours that replaced it.
    """

    def __init__(self, task: PlanTask, scorer: PlanScorer | None = None) -> None:
        """Start from an even plan; see `begin` and `go_on`.

        Args:
            task: The task.
            scorer: Scores the plans; on the task's traffic if None.
        """
        self.task = task
        self._scorer = scorer or PlanScorer(task, task.traffic_seeds, task.batch)
        self.best = even_plan(self._scorer, task.period)
        self.n_rounds = self.n_adopted = 0

    def begin(self) -> None:
        """Take the best of random plans by successive halving, an even plan among them."""
        generator = np.random.default_rng([self.task.seed, 0])
        n_random = 2 * self.task.neighbours + 1
        plans = np.stack([self.best, *(self._random(generator) for _ in range(n_random))])
        n_seeds = 2
        while len(plans) > 1:
            scores = self._scorer.scores(plans, self._seeds(generator, n_seeds), PLAN_SEARCH.start)
            plans = plans[np.argsort(-scores.mean(axis=1))[: len(plans) // 2]]
            n_seeds *= 2
        self.best = plans[0]

    def resume(self, plan: Plan) -> None:
        """Resume an interrupted search from its plan."""
        self.best = plan_masks(plan, self._scorer.n_mainline)
        self.n_rounds = int(plan.provenance["rounds"])
        self.n_adopted = int(plan.provenance["adopted"])

    def go_on(self, n_rounds: int, on_round: Callable[[], None]) -> None:
        """Run rounds until there are ``n_rounds``; call ``on_round`` after each."""
        while self.n_rounds < n_rounds:
            self._round()
            self.n_rounds += 1
            on_round()

    def plan(self) -> Plan:
        """Return the best plan so far, with its provenance."""
        config = self._scorer.env.config
        provenance = {
            "task": dataclasses.asdict(self.task),
            "rounds": self.n_rounds, "adopted": self.n_adopted,
            "privacy": dataclasses.asdict(config.privacy), "warm_up": WARM_UP,
            "noise_seed": PLAN_SEARCH.start, "date": date.today().isoformat(),
            "versions": {name: version(name) for name in ("dptse-env", "libsumo", "numpy")},
        }  # fmt: skip
        sets = tuple(tuple(np.flatnonzero(mask).tolist()) for mask in self.best)
        return Plan(self.task.kind, PlanContext.from_config(config), sets, provenance)

    def _round(self) -> None:
        generator = np.random.default_rng([self.task.seed, 1 + self.n_rounds])
        noise = PLAN_SEARCH.start + NOISE_STEP * (1 + self.n_rounds)
        n_plans, n_seeds = self.task.neighbours, FIRST_SEEDS
        plans = np.stack([self._neighbour(generator) for _ in range(n_plans)])
        while True:
            seeds = self._seeds(generator, n_seeds)
            scores = self._scorer.scores(np.stack([self.best, *plans]), seeds, noise)
            gains = scores[1:] - scores[0]
            order = np.argsort(-gains.mean(axis=1))
            if n_plans == 1:
                break
            n_plans = max((n_plans + 1) // 4 - 1, 1)
            n_seeds = self.task.batch // (n_plans + 1)
            plans, noise = plans[order[:n_plans]], noise + NOISE_STEP // 4
        gain = gains[0]
        if gain.mean() > LEAST_GAIN * gain.std(ddof=1) / np.sqrt(len(gain)):
            self.best, self.n_adopted = plans[0], self.n_adopted + 1

    def _seeds(self, generator: np.random.Generator, n_seeds: int) -> IntArray:
        """Draw traffic seeds, as many as there are at most."""
        seeds = self.task.traffic_seeds
        return generator.choice(seeds, min(n_seeds, len(seeds), self.task.batch), replace=False)

    def _random(self, generator: np.random.Generator) -> BoolArray:
        """Return a random plan that queries all segments equally often over its period."""
        scorer, period = self._scorer, self.task.period
        plan = np.zeros((period, scorer.n_mainline), dtype=bool)
        left: list[int] = []
        for mask in plan:
            while mask.sum() < scorer.bandwidth:
                if not left:
                    left = generator.permutation(scorer.free).tolist()
                fresh = [s for s in left if not mask[s]]
                if not fresh:
                    left += generator.permutation(scorer.free).tolist()
                    continue
                mask[fresh[0]] = True
                left.remove(fresh[0])
        return plan

    def _neighbour(self, generator: np.random.Generator) -> BoolArray:
        """Exchange one segment of one set, or, half of the time, segments between two sets."""
        plan, free = self.best.copy(), self._scorer.free
        while np.array_equal(plan, self.best):
            first = generator.integers(len(plan))
            out = generator.choice(np.flatnonzero(plan[first]))
            into = generator.choice([s for s in free if not plan[first, s]] or [out])
            givers = np.flatnonzero(plan[:, into] & ~plan[:, out])
            if givers.size and generator.random() < 0.5:
                second = generator.choice(givers)
                plan[second, into], plan[second, out] = False, True
            plan[first, out], plan[first, into] = False, True
        return plan


def validation_scores(
    task: PlanTask, plan: Plan, n_seeds: int = 16, records: Records = None
) -> dict[str, float]:
    """Return the mean rewards of a plan and of a round robin on validation traffic."""
    seeds = tuple(VALIDATION_SEEDS[:n_seeds])
    scorer = PlanScorer(task, seeds, n_seeds, records=records)
    round_robin = even_plan(scorer, scorer.n_mainline)
    plans = {"plan": plan_masks(plan, scorer.n_mainline), "round-robin": round_robin}
    return {
        name: float(scorer.scores(masks[None], np.array(seeds), 0).mean())
        for name, masks in plans.items()
    }


def plan_masks(plan: Plan, n_mainline: int) -> BoolArray:
    """Return a plan's sets as masks, shape (period, n_mainline)."""
    masks = np.zeros((len(plan.sets), n_mainline), dtype=bool)
    np.put_along_axis(masks, np.array(plan.sets), True, axis=1)
    return masks


def even_plan(scorer: PlanScorer, period: int) -> BoolArray:
    """Return the first steps of a round robin as masks, shape (period, n_mainline)."""
    even = Shifting(scorer.env.interface, period=1)
    size = scorer.env.single_observation_space.shape or ()
    return even.select(np.arange(period), np.zeros((period, *size), dtype=np.float32))
