"""Plan of the study of policies: its cells, baselines and learned policies."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.evaluation.episodes import check_test_seeds
from dptse_env.config import TEST_SEEDS, VALIDATION_SEEDS
from dptse_env.schedules import COVARIANCE_SCHEDULES, OBSERVATION_SCHEDULES, ORACLES, PLANS
from dptse_env.traffic import CORRIDORS
from dptse_env.traffic.incident import Incident
from dptse_env.utils.validation import require_name

PRIVATE = "dptse_env:dptse/PrivateHighway-v0"
PAPER = "dptse_env:dptse/PaperHighway-v0"
PRIMARY = "primary"
REFERENCE = "paper"
"""The paper's schedule."""
DETERMINISTIC, STOCHASTIC = MODES = ("deterministic", "stochastic")
"""Modes of a learned policy: it takes its likeliest action, or draws an action."""


@dataclass(frozen=True)
class PolicyCell:
    """An environment in which policies are compared.

    Attributes:
        transfers: Cells whose learned policies are run here, too, without training.
        bounds: Oracles that are run; they see the truth.
        without: Schedules that suit the cell but take too long.
    """

    name: str
    description: str
    env: str
    keywords: Mapping[str, Any]
    transfers: tuple[str, ...] = ()
    bounds: tuple[str, ...] = ("oracle-error",)
    without: tuple[str, ...] = ("rollout",)


def _private(name: str, description: str, **fields: Any) -> PolicyCell:
    keywords = {"estimator": "ekf", "bandwidth": 5, **fields.pop("keywords", {})}
    return PolicyCell(name, description, PRIVATE, keywords, **fields)


_INCIDENT = CORRIDORS["paper-highway"].incident
assert isinstance(_INCIDENT, Incident)
CELLS = (
    _private(
        PRIMARY, "PrivateHighway, EKF, B = 5", bounds=("oracle-error", "oracle-greedy"), without=()
    ),
    PolicyCell("paper", "PaperHighway, EKF, B = 5", PAPER, {"estimator": "ekf", "bandwidth": 5}),
    *(
        _private(name, description, keywords=keywords, transfers=(PRIMARY,))
        for name, description, keywords in (
            ("bandwidth-3", "B = 3", {"bandwidth": 3}),
            ("bandwidth-7", "B = 7", {"bandwidth": 7}),
            ("ukf", "UKF", {"estimator": "ukf"}),
            ("mhe", "MHE", {"estimator": "mhe"}),
            ("epsilon-1", "ε = 1", {"epsilon": 1.0}),
            ("epsilon-10", "ε = 10", {"epsilon": 10.0}),
            (
                "paper-incident",
                "the paper's incident in place of random ones",
                {"incident": dataclasses.asdict(_INCIDENT)},
            ),
        )
    ),
)
"""The primary cell, then the secondary cells."""
BASELINES = (
    *(name for name in OBSERVATION_SCHEDULES if name not in ("none", "all")),
    *COVARIANCE_SCHEDULES,
    *PLANS,
)
"""Policies that need no training, against which learned policies are held."""


@dataclass(frozen=True)
class PolicyDesign:
    """The cells of the study, their baselines and traffic.

    Attributes:
        cells: The cells, the primary one first.
        baselines: Schedules that need no training; those that do not suit a cell are left out.
        validation_seeds: Traffic on which the best baseline and the best recipe are chosen; by
            default disjoint from the traffic on which a training keeps its best policy.
        test_seeds: Traffic of all reported results.

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    cells: tuple[PolicyCell, ...] = CELLS
    baselines: tuple[str, ...] = BASELINES
    validation_seeds: tuple[int, ...] = tuple(VALIDATION_SEEDS[100:164])
    test_seeds: tuple[int, ...] = tuple(TEST_SEEDS[:64])

    def __post_init__(self) -> None:
        """Check what no environment checks."""
        names = [cell.name for cell in self.cells]
        if not names or names[0] != PRIMARY or len(set(names)) < len(names):
            raise ValueError(f"cells must be distinct and begin with {PRIMARY!r}, got {names}")
        check_test_seeds(self.test_seeds, "test_seeds")
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

    def cell(self, name: str) -> PolicyCell:
        """Return a cell by its name.

        Raises:
            ValueError: There is none.
        """
        cells = {cell.name: cell for cell in self.cells}
        require_name("cell", name, cells)
        return cells[name]

    def quick(self) -> PolicyDesign:
        """Return a design of the primary cell alone, on few seeds."""
        return dataclasses.replace(
            self,
            cells=self.cells[:1],
            validation_seeds=self.validation_seeds[:8],
            test_seeds=self.test_seeds[:8],
        )

    def to_json(self) -> dict[str, Any]:
        """Return the design as plain JSON."""
        content: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> PolicyDesign:
        """Return the design of plain JSON.

        Raises:
            ValueError: A value is out of range.
        """
        cells = []
        for recorded in content["cells"]:
            fields: dict[str, Any] = {
                key: tuple(value) if isinstance(value, list) else value
                for key, value in recorded.items()
            }
            # Manifests that were frozen with another name of this field stay readable.
            fields.setdefault("description", fields.pop("says", ""))
            cells.append(PolicyCell(**fields))
        rest = {key: tuple(value) for key, value in content.items() if key != "cells"}
        return cls(cells=tuple(cells), **rest)


@dataclass(frozen=True)
class Entry:
    """A policy in a cell, run on every traffic seed: the key of the ledgers.

    Attributes:
        kind: ``baseline``, ``bound`` or ``learned``.
        trained_in: Cell that a learned policy was trained for; empty for schedules.
        training_seed: Seed of its training; -1 for schedules.
    """

    cell: str
    kind: str
    policy: str
    trained_in: str = ""
    training_seed: int = -1
    mode: str = DETERMINISTIC


@dataclass(frozen=True)
class Learner:
    """The policies of one recipe, of all its training seeds, in one cell and one mode.

    Attributes:
        cell: Cell in which it is run.
        trained_in: Cell that it was trained for.
    """

    cell: str
    policy: str
    trained_in: str
    mode: str

    def entry(self, training_seed: int) -> Entry:
        """Return the entry of a training seed."""
        return Entry(self.cell, "learned", self.policy, self.trained_in, training_seed, self.mode)

    @property
    def label(self) -> str:
        """The name in figures and tables."""
        moved = "" if self.trained_in == self.cell else f", from {self.trained_in}"
        return self.policy + moved + (" (drawn)" if self.mode == STOCHASTIC else "")
