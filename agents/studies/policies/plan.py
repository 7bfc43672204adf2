"""What is run: the cells, the ladder of baselines, and who stands on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.evaluation.episodes import check_held_out
from dptse_env.config import TEST_SEEDS, VALIDATION_SEEDS
from dptse_env.schedules import INFORMED, ORACLES, PLANS, SCHEDULES
from dptse_env.traffic import CORRIDORS

PRIVATE = "dptse_env:dptse/PrivateHighway-v0"
PAPER = "dptse_env:dptse/PaperHighway-v0"
PRIMARY = "primary"
REFERENCE = "paper"
"""The paper's schedule."""
DETERMINISTIC, STOCHASTIC = MODES = ("deterministic", "stochastic")
"""Whether a learned policy takes its likeliest action or draws one."""


@dataclass(frozen=True)
class Cell:
    """One environment, with all who are compared in it.

    Attributes:
        name: Short name.
        says: What it is, in words.
        env: Environment id.
        keywords: Keywords of ``gym.make`` that make it.
        transfers: Cells whose learned policies are run here, too, without training.
        bounds: Oracles that are run; they see the truth.
        without: Schedules that would suit but take too long to be run here, too.
    """

    name: str
    says: str
    env: str
    keywords: Mapping[str, Any]
    transfers: tuple[str, ...] = ()
    bounds: tuple[str, ...] = ("oracle-error",)
    without: tuple[str, ...] = ("rollout",)


def _private(name: str, says: str, **fields: Any) -> Cell:
    own = {"estimator": "ekf", "bandwidth": 5, **fields.pop("keywords", {})}
    return Cell(name, says, PRIVATE, own, **fields)


_INCIDENT = dataclasses.asdict(CORRIDORS["paper-highway"].incident)  # type: ignore[arg-type]
CELLS = (
    _private(
        PRIMARY,
        "PrivateHighway, EKF, B = 5",
        bounds=("oracle-error", "oracle-greedy"),
        without=(),
    ),
    Cell("paper", "PaperHighway, EKF, B = 5", PAPER, {"estimator": "ekf", "bandwidth": 5}),
    *(
        _private(name, says, keywords=keywords, transfers=(PRIMARY,))
        for name, says, keywords in (
            ("bandwidth-3", "B = 3", {"bandwidth": 3}),
            ("bandwidth-7", "B = 7", {"bandwidth": 7}),
            ("ukf", "UKF", {"estimator": "ukf"}),
            ("mhe", "MHE", {"estimator": "mhe"}),
            ("epsilon-1", "ε = 1", {"epsilon": 1.0}),
            ("epsilon-10", "ε = 10", {"epsilon": 10.0}),
            (
                "paper-incident",
                "the paper's incident in place of random ones",
                {"incident": _INCIDENT},
            ),
        )
    ),
)
"""The primary cell, then the secondary ones."""
BASELINES = (*(name for name in SCHEDULES if name not in ("none", "all")), *INFORMED, *PLANS)
"""Policies that need no training: the ladder that a learned one must climb."""


@dataclass(frozen=True)
class Design:
    """Everything that is run.

    Attributes:
        cells: The cells, the primary one first.
        baselines: Schedules that need no training; those that do not suit a cell are left out.
        validation_seeds: Traffic on which the best baseline and the best recipe are chosen; by
            default apart from that on which a training keeps its best policy.
        test_seeds: Traffic of everything that is reported.

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    cells: tuple[Cell, ...] = CELLS
    baselines: tuple[str, ...] = BASELINES
    validation_seeds: tuple[int, ...] = tuple(VALIDATION_SEEDS[100:164])
    test_seeds: tuple[int, ...] = tuple(TEST_SEEDS[:64])

    def __post_init__(self) -> None:
        """Check what no environment checks."""
        names = [cell.name for cell in self.cells]
        if not names or names[0] != PRIMARY or len(set(names)) < len(names):
            raise ValueError(f"cells must be distinct and begin with {PRIMARY!r}, got {names}")
        check_held_out(self.test_seeds)
        chosen = self.validation_seeds
        if len(set(chosen)) < max(len(chosen), 2) or set(chosen) - set(VALIDATION_SEEDS):
            raise ValueError(
                f"validation_seeds must be 2 or more, distinct and in {VALIDATION_SEEDS[0]}.."
                f"{VALIDATION_SEEDS[-1]}, got {chosen}"
            )
        wrong = [name for name in self.baselines if name in ORACLES]
        if wrong or REFERENCE not in self.baselines:
            raise ValueError(
                f"baselines must hold {REFERENCE!r} and no oracle, got {self.baselines}"
            )

    def cell(self, name: str) -> Cell:
        """Return a cell by its name.

        Raises:
            ValueError: There is none.
        """
        for cell in self.cells:
            if cell.name == name:
                return cell
        known = ", ".join(cell.name for cell in self.cells)
        raise ValueError(f"cell must be one of {known}, got {name!r}")


def quick(design: Design) -> Design:
    """Return a design of the primary cell alone, on few seeds."""
    return dataclasses.replace(
        design,
        cells=design.cells[:1],
        validation_seeds=design.validation_seeds[:8],
        test_seeds=design.test_seeds[:8],
    )


@dataclass(frozen=True)
class Entry:
    """A policy in a cell, run on every traffic seed: what a ledger's rows are of.

    Attributes:
        cell: Name of the cell.
        kind: ``baseline``, ``bound`` or ``learned``.
        policy: Name of the schedule or of the recipe.
        trained_in: Cell that a learned policy was trained for; empty for others.
        training_seed: Seed of its training; -1 for others.
        mode: How it acts, one of `MODES`; schedules have one way only.
    """

    cell: str
    kind: str
    policy: str
    trained_in: str = ""
    training_seed: int = -1
    mode: str = DETERMINISTIC


@dataclass(frozen=True)
class Learner:
    """The runs of one recipe, by whatever training seeds there are, in one cell and one mode.

    Attributes:
        cell: Cell in which it is run.
        policy: Name of the recipe.
        trained_in: Cell that it was trained for.
        mode: One of `MODES`.
    """

    cell: str
    policy: str
    trained_in: str
    mode: str

    def entry(self, training_seed: int) -> Entry:
        """Return the entry of one of its runs."""
        return Entry(self.cell, "learned", self.policy, self.trained_in, training_seed, self.mode)

    @property
    def label(self) -> str:
        """Name it in figures and tables."""
        moved = "" if self.trained_in == self.cell else f", from {self.trained_in}"
        return self.policy + moved + (" (drawn)" if self.mode == STOCHASTIC else "")
