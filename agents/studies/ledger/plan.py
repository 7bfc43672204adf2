"""Plan of the study of ledgers: its cells, and the comparisons that they serve."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from agents.experiments.cells import Design
from agents.studies.ledger.cell import (
    CAPPED,
    DEMAND,
    EQUAL_RATES,
    EXACT,
    FILTER_LABELS,
    FILTERS,
    PACED,
    PLAIN,
    REFERENCE,
    SPAN,
    TRACER,
    WALK,
    FilterSets,
    LedgerCell,
)
from dptse_env.schedules import COVARIANCE_SCHEDULES, OBSERVATION_SCHEDULES


class Rung(NamedTuple):
    """A step of the ladder: a cell, and an earlier one that it differs from in one thing."""

    label: str
    cell: LedgerCell
    base: LedgerCell | None


class Named(NamedTuple):
    """A cell with its name in a table."""

    label: str
    cell: LedgerCell


@dataclass(frozen=True)
class LedgerDesign(Design[LedgerCell]):
    """The cells of the study; traffic, ARZ parameters and horizon are the environment's.

    Cells have the base values of what they do not vary: ``paced``, the EKF with demand states, and
    the fields below.

    Attributes:
        schedule: Base schedule.
        epsilons: Values of epsilon; the base value is added.
        paces: Values of the pace; the base value is added.
        clips: Values of the clip [km/h]; the base value is added.
        ratios: Values of the ratio; the base value is added.
        schedules: Schedules that are compared.
        sets: Sets of estimator settings.
        single_only: Whether sums over two neighbours are left out.
        epsilon: Base value of epsilon.
        low_epsilon: Smaller epsilon, at which the ladder is shown as well.
        delta: Base value of delta.
        strict_delta: Smaller delta, at which the ladder, epsilon and pace are shown as well.
        bandwidth: Base value of the bandwidth.
        pace: Base value of the pace.
        clip: Base value of the clip [km/h].
        ratio: Base value of the ratio.
    """

    env: str = "dptse_env:dptse/PrivateHighway-v0"
    schedule: str = "round-robin"
    epsilons: tuple[float, ...] = (0.5, 1.0, 2.0, 5.0, 10.0)
    paces: tuple[float, ...] = (0.6, 0.7, 0.8, 0.85, 0.9, 1.0)
    clips: tuple[float, ...] = (18.0, 25.0, 35.0, 51.0, 102.0)
    ratios: tuple[float, ...] = (0.25, 0.5, 1.0)
    schedules: tuple[str, ...] = (
        "static", "paper", "round-robin", "random", "oldest-first", "largest-variance",
        "stale-variance", "greedy-trace", "inflated-trace",
    )  # fmt: skip
    sets: FilterSets = field(default_factory=FilterSets)
    single_only: bool = False
    epsilon: float = 5.0
    low_epsilon: float = 1.0
    delta: float = 0.05
    strict_delta: float = 0.001
    bandwidth: int = 5
    pace: float = 0.85
    clip: float = 25.0
    ratio: float = 1.0

    def __post_init__(self) -> None:
        """Sort the grids with their base values in them."""
        for name, base in self._grids.items():
            object.__setattr__(self, name, tuple(sorted({*getattr(self, name), base})))

    @property
    def _grids(self) -> dict[str, float]:
        """Base values by the names of their grids."""
        return {
            "epsilons": self.epsilon,
            "paces": self.pace,
            "clips": self.clip,
            "ratios": self.ratio,
        }

    def check(self) -> None:
        """See `Design.check`."""
        super().check()
        known = [*OBSERVATION_SCHEDULES.keys() - {"none", "all"}, *COVARIANCE_SCHEDULES]
        unknown = [name for name in self.schedules if name not in known]
        if unknown or len(set(self.schedules)) < max(len(self.schedules), 1):
            raise ValueError(
                f"schedules must be distinct and of {', '.join(sorted(known))}, got "
                f"{self.schedules}"
            )
        for name, base in self._grids.items():
            values = getattr(self, name)
            if len(values) < 2:
                raise ValueError(f"{name} must hold a value beside {base:g}, got {values}")

    @property
    def deltas(self) -> tuple[float, float]:
        """The base value of delta and the smaller one."""
        return self.delta, self.strict_delta

    @property
    def guarantees(self) -> tuple[tuple[float, float], ...]:
        """The values of (epsilon, delta) at which the ladder is shown, the base values first."""
        return (
            (self.epsilon, self.delta),
            (self.low_epsilon, self.delta),
            (self.epsilon, self.strict_delta),
        )

    def cell(self, mechanism: str = PACED, filter_name: str = DEMAND, **changes: Any) -> LedgerCell:
        """Return a cell; fields that are not given have base values."""
        base = LedgerCell(
            mechanism=mechanism,
            filter_name=filter_name,
            settings=self.sets.find(mechanism, filter_name),
            schedule=self.schedule,
            epsilon=self.epsilon,
            delta=self.delta,
            adjacency="replace",
            unit="trip",
            boundary_inputs="nominal",
            span=1,
            bandwidth=self.bandwidth,
            bandwidth_unit="segments",
            pace=self.pace,
            clip=self.clip,
            ratio=self.ratio,
            pacing=TRACER,
        )
        return dataclasses.replace(base, **changes).canonical

    @property
    def shipped(self) -> LedgerCell:
        """The mechanism ``capped`` with the settings and the schedule that they were tuned for."""
        return self.cell(CAPPED, PLAIN, schedule=REFERENCE)

    def ladder(self, epsilon: float | None = None, delta: float | None = None) -> list[Rung]:
        """Return the steps from capped contributions to sums over neighbours, and to no noise."""
        at: dict[str, Any] = {
            "epsilon": self.epsilon if epsilon is None else epsilon,
            "delta": self.delta if delta is None else delta,
        }
        first = self.cell(CAPPED, PLAIN, schedule=REFERENCE, **at)
        filtered = self.cell(CAPPED, DEMAND, schedule=REFERENCE, **at)
        both = self.cell(PACED, DEMAND, schedule=REFERENCE, **at)
        base, walk = self.cell(**at), self.cell(CAPPED, WALK, **at)
        n, turn = self.bandwidth, f"`{self.schedule}`"
        rungs = [
            Rung(f"`capped`, EKF, `{REFERENCE}`", first, None),
            Rung(f"`capped`, demand states, `{REFERENCE}`", filtered, first),
            Rung(
                f"`paced`, EKF, `{REFERENCE}`",
                self.cell(PACED, PLAIN, schedule=REFERENCE, **at),
                first,
            ),
            Rung(f"`paced`, demand states, `{REFERENCE}`", both, filtered),
            Rung(f"`paced`, demand states, {turn}", base, both),
            Rung(f"`capped`, demand states, {turn}", self.cell(CAPPED, **at), filtered),
            Rung(f"`paced`, {2 * n} segments a second", self.cell(bandwidth=2 * n, **at), base),
            *self._pair_rungs(base, at),
            Rung(f"`capped`, random walk, {turn}", walk, None),
            Rung(f"`paced`, random walk, {turn}", self.cell(PACED, WALK, **at), walk),
            Rung(f"no noise, demand states, {turn}", self.cell(EXACT), base),
        ]
        if not self.single_only:
            sums = self.sums(**at)
            rungs.append(Rung(f"no noise, {n} sums of {SPAN}", self.sums(EXACT), sums))
        return rungs

    def sums(self, mechanism: str = PACED, **changes: Any) -> LedgerCell:
        """Return a cell of as many sums over neighbours as the bandwidth, whatever their span."""
        return self.cell(mechanism, span=SPAN, bandwidth_unit="sums", **changes)

    def _pair_rungs(self, base: LedgerCell, at: dict[str, Any]) -> list[Rung]:
        """Return rungs of sums over neighbours: as many as segments before, then for their cost."""
        if self.single_only:
            return []
        n = self.bandwidth
        rungs = [Rung(f"`paced`, {n} sums of {SPAN}", self.sums(**at), base)]
        for cost in sorted({n - n % SPAN, n + -n % SPAN}):
            label = f"`paced`, {cost // SPAN} sums of {SPAN}, {cost} segments"
            rungs.append(Rung(label, self.cell(span=SPAN, bandwidth=cost, **at), base))
        return rungs

    def filters(self, **changes: Any) -> list[Named]:
        """Return the cells of all filters under ``paced``, the base filter first."""
        names = [DEMAND, *(name for name in FILTERS if name not in (PLAIN, DEMAND))]
        return [Named(FILTER_LABELS[name], self.cell(PACED, name, **changes)) for name in names]

    @property
    def filter_tables(self) -> dict[str, list[Named]]:
        """Cells of all filters, by what is queried."""
        n = self.bandwidth
        tables = {f"{n} segments": self.filters()}
        if not self.single_only:
            name = f"{n} sums of {SPAN} neighbours"
            tables[name] = self.filters(span=SPAN, bandwidth_unit="sums")
        return tables

    def along_epsilon(self, mechanism: str, delta: float) -> list[LedgerCell]:
        """Return the cells of one curve over epsilon."""
        return [self.cell(mechanism, epsilon=value, delta=delta) for value in self.epsilons]

    def variants(self, mechanism: str) -> list[Named]:
        """Return the base cell of a mechanism and those that protect something else."""
        changes: dict[str, dict[str, Any]] = {
            "a trip, replaced, with nominal boundary inputs": {},
            "added or removed in place of replaced": {"adjacency": "add_remove"},
            "a second in place of a trip": {"unit": "event"},
            "private boundary inputs in place of nominal ones": {"boundary_inputs": "private"},
        }
        return [Named(label, self.cell(mechanism, **each)) for label, each in changes.items()]

    def along(self, name: str, **changes: Any) -> list[LedgerCell]:
        """Return the cells of one setting of ``paced``: ``pace``, ``clip`` or ``ratio``."""
        values = getattr(self, f"{name}s")
        return [self.cell(**{name: value}, **changes) for value in values]

    def policy_cells(self, schedule: str) -> tuple[LedgerCell, LedgerCell, LedgerCell]:
        """Return the cells of a schedule: capped, paced by the queries, and by equal rates."""
        return (
            self.cell(CAPPED, schedule=schedule),
            self.cell(PACED, schedule=schedule),
            self.cell(PACED, schedule=schedule, pacing=EQUAL_RATES),
        )

    @property
    def watched(self) -> list[Named]:
        """Cells whose vehicles are followed one by one."""
        names = list(dict.fromkeys([self.schedule, REFERENCE, *self.schedules]))
        return [
            *(Named(f"`paced`, `{name}`", self.cell(schedule=name)) for name in names),
            *(
                Named(f"`paced`, `{self.schedule}`, pace {cell.pace:g}", cell)
                for cell in self.along("pace")
                if cell.pace != self.pace
            ),
            *(Named(f"`capped`, `{name}`", self.cell(CAPPED, schedule=name)) for name in names),
        ]

    def all_cells(self) -> Iterator[LedgerCell]:
        """Yield the cells of every table and figure."""
        for guarantee in self.guarantees:
            yield from (rung.cell for rung in self.ladder(*guarantee))
        for named in self.filter_tables.values():
            yield from (each.cell for each in named)
        for mechanism in (CAPPED, PACED):
            for delta in self.deltas:
                yield from self.along_epsilon(mechanism, delta)
            yield from (each.cell for each in self.variants(mechanism))
        for delta in self.deltas:
            yield from self.along("pace", delta=delta)
        yield from self.along("clip")
        yield from self.along("ratio")
        for name in self.schedules:
            yield from self.policy_cells(name)
        yield from (each.cell for each in self.watched)

    def quick(self) -> LedgerDesign:
        """Return a design of the same results with fewer points and seeds."""

        def ends(values: tuple[float, ...]) -> tuple[float, ...]:
            return values[0], values[-1]

        return dataclasses.replace(
            self,
            seeds=self.first_seeds(3),
            epsilons=(*ends(self.epsilons), self.low_epsilon),
            paces=ends(self.paces),
            clips=ends(self.clips),
            ratios=ends(self.ratios),
            schedules=tuple(name for name in self.schedules if name in QUICK_SCHEDULES),
        )


QUICK_SCHEDULES = ("static", "round-robin", "largest-variance")
"""Schedules of the quick design."""
