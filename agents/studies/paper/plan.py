"""Plan of the reproduction: the paper's sweeps, and the cells that they share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from agents.experiments.cells import Design
from dptse_env.estimators import check_estimator

PAPER_ESTIMATORS = ("ekf", "ukf", "enkf", "mhe")
"""The paper's estimators, in its order."""
BASELINE_ESTIMATORS = ("random_walk", "open_loop")
"""Run beside them in every result: without a traffic model, and without measurements."""
EPSILON, DELTA = 1.0, 0.05
"""The paper's privacy parameters wherever they are not swept."""


class Setting(NamedTuple):
    """A choice that the paper leaves open; each result is shown under all of them."""

    privacy: str
    parameters: str

    def __str__(self) -> str:
        """Return both names."""
        return f"{self.privacy} noise, {self.parameters} parameters"


SETTINGS = tuple(
    Setting(privacy, parameters)
    for privacy in ("paper", "corrected")
    for parameters in ("paper", "w99-3lane")
)


@dataclass(frozen=True)
class PaperCell:
    """A configuration, run on every traffic seed.

    Attributes:
        bandwidth: CV segments queried a second.
    """

    estimator: str
    parameters: str
    privacy: str
    epsilon: float
    delta: float
    bandwidth: int

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class PaperDesign(Design[PaperCell]):
    """The cells of the paper's results.

    Attributes:
        cv_segments: Numbers of CV segments of result 1.
        epsilons: Values of epsilon of result 3; 1 is added.
        deltas: Values of delta of result 4; 0.05 is added.
        picture_segments: CV segments of result 2.
        privacy_segments: CV segments of results 3, 4 and 5.
        n_timed: Most traffic seeds behind each time of result 5.
        estimators: Estimators of the paper; random walk and open loop are always run.
    """

    cv_segments: tuple[int, ...] = tuple(range(5, 12))
    epsilons: tuple[float, ...] = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0, 10.0)
    deltas: tuple[float, ...] = (0.001, 0.003, 0.01, 0.03, 0.05, 0.1, 0.2)
    picture_segments: int = 7
    privacy_segments: int = 5
    n_timed: int = 10
    estimators: tuple[str, ...] = PAPER_ESTIMATORS

    def check(self) -> None:
        """See `Design.check`."""
        super().check()
        if self.n_timed < 2:
            raise ValueError(f"n_timed must be >= 2, got {self.n_timed}")
        for name in self.estimators:
            check_estimator(name, "compiled")
            if name not in PAPER_ESTIMATORS:
                raise ValueError(
                    f"estimators must be among {', '.join(PAPER_ESTIMATORS)}, got {name!r}; "
                    f"{' and '.join(BASELINE_ESTIMATORS)} are always run"
                )
        if len(set(self.cv_segments)) < 3:
            raise ValueError(f"cv_segments must be 3 or more values, got {self.cv_segments}")
        if not min(self.epsilons, default=1.0) < EPSILON < max(self.epsilons):
            raise ValueError(f"epsilons must lie on both sides of 1, got {self.epsilons}")
        if len({*self.deltas, DELTA}) < 2:
            raise ValueError(f"deltas must hold a value beside {DELTA}, got {self.deltas}")

    @property
    def all_estimators(self) -> tuple[str, ...]:
        """The paper's estimators that are run, in its order, then the baselines."""
        return (
            *(name for name in PAPER_ESTIMATORS if name in self.estimators),
            *BASELINE_ESTIMATORS,
        )

    @property
    def sweeps(self) -> dict[str, tuple[float, ...]]:
        """Values of the sweeps of results 1, 3 and 4, ascending, by the field that varies."""
        values: dict[str, Sequence[float]] = {
            "bandwidth": self.cv_segments,
            "epsilon": (*self.epsilons, EPSILON),
            "delta": (*self.deltas, DELTA),
        }
        return {field: tuple(sorted(set(grid))) for field, grid in values.items()}

    def base(self, estimator: str, setting: Setting) -> PaperCell:
        """Return the cell of the paper's privacy and the fewest CV segments."""
        privacy, parameters = setting
        segments = self.privacy_segments
        return canonical(PaperCell(estimator, parameters, privacy, EPSILON, DELTA, segments))

    def along(self, field: str, estimator: str, setting: Setting) -> list[PaperCell]:
        """Return the cells of one curve, in the order of the sweep's values."""
        base = self.base(estimator, setting)
        changes: list[dict[str, Any]] = [{field: value} for value in self.sweeps[field]]
        return [canonical(dataclasses.replace(base, **change)) for change in changes]

    def picture(self, estimator: str, setting: Setting) -> PaperCell:
        """Return the cell that result 2 shows."""
        base = self.base(estimator, setting)
        return canonical(dataclasses.replace(base, bandwidth=self.picture_segments))

    def all_cells(self) -> Iterator[PaperCell]:
        """Yield the cells of results 1, 3 and 4."""
        for setting in SETTINGS:
            for estimator in self.all_estimators:
                yield from self.cells_of(estimator, setting)

    def cells_of(self, estimator: str, setting: Setting) -> Iterator[PaperCell]:
        """Yield the cells of an estimator under a setting."""
        yield self.base(estimator, setting)
        for field in self.sweeps:
            yield from self.along(field, estimator, setting)

    def timed(self) -> list[tuple[PaperCell, int]]:
        """Return the episodes that are timed; estimators alternate, so that drift hits them all."""
        cells = [self.base(name, setting) for setting in SETTINGS for name in self.all_estimators]
        seeds = self.traffic_seeds[: self.n_timed]
        return [(cell, seed) for seed in seeds for cell in dict.fromkeys(cells)]

    def quick(self) -> PaperDesign:
        """Return a design of the same results with fewer points and seeds."""

        def thin(values: Sequence[float], kept: float) -> tuple[float, ...]:
            return tuple(sorted({values[0], values[-1], kept}))

        middle = self.cv_segments[len(self.cv_segments) // 2]
        return dataclasses.replace(
            self,
            seeds=self.first_seeds(4),
            cv_segments=tuple(int(n) for n in thin(self.cv_segments, middle)),
            epsilons=thin(self.epsilons, EPSILON),
            deltas=thin(self.deltas, DELTA),
            n_timed=4,
        )


def canonical(cell: PaperCell) -> PaperCell:
    """Return the cell that stands for all that give the same episodes.

    The open loop uses no release, so neither noise nor queries matter to it.
    """
    if cell.estimator != "open_loop":
        return cell
    return dataclasses.replace(cell, privacy="paper", epsilon=EPSILON, delta=DELTA, bandwidth=1)
