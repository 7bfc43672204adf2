"""What the recurrent network was asked to reach, and the verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from agents.experiments.cells import DENSITY, SPEED
from agents.studies.estimators.cell import LEARNED, EstimatorCell
from agents.studies.estimators.plan import OWN, EstimatorDesign
from agents.studies.estimators.results import ERROR, EstimatorResults
from agents.studies.estimators.worlds import ELSEWHERE, GUARANTEES, MAIN

CHI2 = (0.8, 1.25)
"""Range of chi-square in which deviations count as honest."""
OFF_TRAINING = 20.0
"""Least percentage below the EKF away from the training."""
BELOW_WALK = 25.0
"""Least percentage of the speed error below the random walk's."""
MADE_BAD = ("other-traffic",)
"""Worlds in which an estimator ought to fail."""


class Verdict(NamedTuple):
    """A target, and the worst of the training seeds."""

    statement: str
    asked: str
    reached: str
    is_met: bool


def judge(results: EstimatorResults) -> list[Verdict]:
    """Return the verdicts on all targets; the worst training seed counts."""
    design = results.design
    found = [
        _error(results, "capped", "", "`PrivateHighway-v0`", 70.0),
        _error(results, "capped", OWN, f"`PrivateHighway-v0`, `{OWN}`", 65.0),
        _metric(results, "printed", DENSITY, "`PaperHighway-v0`, density", 11.3),
        _metric(results, "printed", SPEED, "`PaperHighway-v0`, speed", 5.2),
        _error(results, "paced", "", "`PrivateHighway-v1`", 60.0),
        _error(results, "paced-sums", "", "`PrivateHighway-v1`, five sums", 55.0),
        _error(results, "paced-low-sums", "", "`PrivateHighway-v1`, five sums, ε = 1", 70.0),
    ]
    worlds = (*MAIN, *GUARANTEES)
    cells = [cell for world in worlds for cell in networks(design, world)]
    for name in ("density", "speed"):
        values = [results.mean(cell, f"chi2_{name}").mean for cell in cells]
        inside = all(CHI2[0] <= value <= CHI2[1] for value in values)
        found.append(
            Verdict(
                f"χ² of {name}, every world and training seed", f"{CHI2[0]:g} to {CHI2[1]:g}",
                f"{min(values):.2f} to {max(values):.2f}", inside,
            )
        )  # fmt: skip
    moved = [
        results.below(design.cell(world), design.cell(world, "ekf")).mean
        for world in ELSEWHERE
        if world not in MADE_BAD
    ]
    found.append(
        Verdict(
            "Below the EKF away from the training, each", f">= {OFF_TRAINING:g} %",
            f"{min(moved):.1f} % at least", min(moved) >= OFF_TRAINING,
        )
    )  # fmt: skip
    walks = [
        results.below(cell, design.cell(cell.world, "random_walk"), SPEED).mean for cell in cells
    ]
    found.append(
        Verdict(
            "Speed error below the random walk's, every world", f">= {BELOW_WALK:g} %",
            f"{min(walks):.1f} % at least", min(walks) >= BELOW_WALK,
        )
    )  # fmt: skip
    return found


def networks(design: EstimatorDesign, world: str, schedule: str = "") -> list[EstimatorCell]:
    """Return the cells of all training seeds in a world."""
    return [design.cell(world, LEARNED, schedule, weights) for weights in design.all_networks]


def _error(
    results: EstimatorResults, world: str, schedule: str, statement: str, limit: float
) -> Verdict:
    cells = networks(results.design, world, schedule)
    return _judged(results, cells, ERROR, f"{statement}, error x 1000", limit)


def _metric(
    results: EstimatorResults, world: str, metric: str, statement: str, limit: float
) -> Verdict:
    return _judged(results, networks(results.design, world), metric, statement, limit)


def _judged(
    results: EstimatorResults,
    cells: Sequence[EstimatorCell],
    metric: str,
    statement: str,
    limit: float,
) -> Verdict:
    worst = results.mean(results.worst(cells, metric), metric).mean
    return Verdict(statement, f"<= {limit:g}", f"{worst:.1f}", worst <= limit)
