"""What is run to reproduce the paper: its sweeps, and the cells that they share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from agents.evaluation.episodes import check_held_out
from dptse_env.config import TEST_SEEDS
from dptse_env.estimators import check_estimator

ESTIMATORS = ("ekf", "ukf", "enkf", "mhe")
"""The paper's estimators, in its order."""
BASELINES = ("random_walk", "open_loop")
"""No traffic model, and no measurements: run beside the others in every result."""
SCHEDULE = "paper"
"""Query schedule of every episode."""
EPSILON, DELTA = 1.0, 0.05
"""The paper's privacy parameters wherever they are not swept."""


class Setting(NamedTuple):
    """What the paper leaves open: each result is shown under all of them.

    Attributes:
        privacy: Privacy preset.
        parameters: ARZ parameter set of the estimator's model.
    """

    privacy: str
    parameters: str

    def __str__(self) -> str:
        """Name both."""
        return f"{self.privacy} noise, {self.parameters} parameters"


SETTINGS = tuple(
    Setting(privacy, parameters)
    for privacy in ("paper", "corrected")
    for parameters in ("paper", "w99-3lane")
)


@dataclass(frozen=True)
class Cell:
    """One configuration, run on every traffic seed.

    Attributes:
        estimator: Name of the estimator.
        parameters: Name of the ARZ parameter set.
        privacy: Privacy preset.
        epsilon: Privacy parameter.
        delta: Privacy parameter.
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
class Sweep:
    """One field of a cell over its values, the others held.

    Attributes:
        field: Field of `Cell` that varies.
        values: Its values, ascending.
        bandwidth: CV segments where they do not vary.
    """

    field: str
    values: tuple[float, ...]
    bandwidth: int

    @property
    def base(self) -> float:
        """The value of the field where another one is swept."""
        return {"epsilon": EPSILON, "delta": DELTA, "bandwidth": self.bandwidth}[self.field]


@dataclass(frozen=True)
class Design:
    """Everything that is run.

    Attributes:
        seeds: Held-out traffic seeds, of `TEST_SEEDS`; each is the seed of the noise, too.
        cv_segments: Numbers of CV segments of result 1.
        epsilons: Values of result 3; 1 is added.
        deltas: Values of result 4; 0.05 is added.
        picture_segments: CV segments of result 2.
        privacy_segments: CV segments of results 3, 4 and 5.
        n_timed: Most traffic seeds behind each time of result 5.
        estimators: Those of the paper's estimators that are run; the baselines always are.
        env: Environment id.

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    seeds: tuple[int, ...] = tuple(TEST_SEEDS[:20])
    cv_segments: tuple[int, ...] = tuple(range(5, 12))
    epsilons: tuple[float, ...] = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0, 10.0)
    deltas: tuple[float, ...] = (0.001, 0.003, 0.01, 0.03, 0.05, 0.1, 0.2)
    picture_segments: int = 7
    privacy_segments: int = 5
    n_timed: int = 10
    estimators: tuple[str, ...] = ESTIMATORS
    env: str = "dptse_env:dptse/PaperHighway-v0"
    schedule: ClassVar[str] = SCHEDULE

    def __post_init__(self) -> None:
        """Check what no environment checks."""
        check_held_out(self.seeds)
        if self.n_timed < 2:
            raise ValueError(f"n_timed must be >= 2, got {self.n_timed}")
        for name in self.estimators:
            check_estimator(name, "compiled")
            if name not in ESTIMATORS:
                raise ValueError(
                    f"estimators must be among {', '.join(ESTIMATORS)}, got {name!r}; "
                    f"{' and '.join(BASELINES)} are always run"
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
        return (*(name for name in ESTIMATORS if name in self.estimators), *BASELINES)

    @property
    def sweeps(self) -> dict[str, Sweep]:
        """The sweeps of results 1, 3 and 4 by the field that varies."""
        values: dict[str, Sequence[float]] = {
            "bandwidth": self.cv_segments,
            "epsilon": (*self.epsilons, EPSILON),
            "delta": (*self.deltas, DELTA),
        }
        return {
            field: Sweep(field, tuple(sorted(set(own))), self.privacy_segments)
            for field, own in values.items()
        }

    def base(self, estimator: str, setting: Setting) -> Cell:
        """Return the cell of the paper's privacy and the fewest CV segments."""
        return canonical(
            Cell(
                estimator,
                setting.parameters,
                setting.privacy,
                EPSILON,
                DELTA,
                self.privacy_segments,
            )
        )

    def along(self, field: str, estimator: str, setting: Setting) -> list[Cell]:
        """Return the cells of one curve, in the order of the sweep's values."""
        base = self.base(estimator, setting)
        return [
            canonical(dataclasses.replace(base, **{field: value}))
            for value in self.sweeps[field].values
        ]

    def picture(self, estimator: str, setting: Setting) -> Cell:
        """Return the cell that result 2 shows."""
        base = self.base(estimator, setting)
        return canonical(dataclasses.replace(base, bandwidth=self.picture_segments))

    def cells(self) -> list[Cell]:
        """Return every cell of results 1, 3 and 4 once."""

        def all_of_them() -> Iterator[Cell]:
            for setting in SETTINGS:
                for estimator in self.all_estimators:
                    yield self.base(estimator, setting)
                    for field in self.sweeps:
                        yield from self.along(field, estimator, setting)

        return list(dict.fromkeys(all_of_them()))

    def timed(self) -> list[tuple[Cell, int]]:
        """Return the episodes that are timed; estimators alternate, so that drift hits them all."""
        cells = [self.base(name, setting) for setting in SETTINGS for name in self.all_estimators]
        return [
            (cell, seed) for seed in self.seeds[: self.n_timed] for cell in dict.fromkeys(cells)
        ]


def canonical(cell: Cell) -> Cell:
    """Return the cell that stands for all that give the same episodes.

    The open loop takes in nothing that is released, so neither noise nor queries matter to it.
    """
    if cell.estimator != "open_loop":
        return cell
    return dataclasses.replace(cell, privacy="paper", epsilon=EPSILON, delta=DELTA, bandwidth=1)


def quick(design: Design) -> Design:
    """Return a design that shows the same results with fewer points and seeds."""

    def thin(values: Sequence[float], keep: float | None = None) -> tuple[float, ...]:
        ends = (values[0], values[-1])
        middle = values[len(values) // 2] if keep is None else keep
        return tuple(sorted({*ends, middle}))

    return dataclasses.replace(
        design,
        seeds=design.seeds[:4],
        cv_segments=tuple(int(n) for n in thin(design.cv_segments)),
        epsilons=thin(design.epsilons, EPSILON),
        deltas=thin(design.deltas, DELTA),
        n_timed=4,
    )
