"""What the recurrent network was asked to reach, and the verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from agents.experiments.cells import DENSITY, ERROR, SPEED
from agents.studies.estimators.cell import LEARNED, EstimatorCell
from agents.studies.estimators.plan import OWN, EstimatorDesign
from agents.studies.estimators.results import EstimatorResults

CHI2 = (0.8, 1.25)
"""Range of chi-square in which deviations count as honest."""
OFF_TRAINING = 20.0
"""Least percentage below the EKF away from the training."""
BELOW_WALK = 25.0
"""Least percentage of the speed error below the random walk's."""
MADE_BAD = ("other-traffic",)
"""Worlds in which an estimator ought to fail."""


ERRORS = (
    ("capped", "", ERROR, "`PrivateHighway-v0`, error x 1000", 70.0),
    ("capped", OWN, ERROR, f"`PrivateHighway-v0`, `{OWN}`, error x 1000", 65.0),
    ("printed", "", DENSITY, "`PaperHighway-v0`, density [veh/km]", 11.3),
    ("printed", "", SPEED, "`PaperHighway-v0`, speed [km/h]", 5.2),
    ("paced", "", ERROR, "`PrivateHighway-v1`, error x 1000", 60.0),
    ("paced-sums", "", ERROR, "`PrivateHighway-v1`, five sums, error x 1000", 55.0),
    ("paced-low-sums", "", ERROR, "`PrivateHighway-v1`, five sums, ε = 1, error x 1000", 70.0),
)
"""World, schedule (the base one if empty), metric, statement and largest mean."""


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
        _judged(results, networks(design, world, schedule), metric, statement, limit)
        for world, schedule, metric, statement, limit in ERRORS
        if world in design.run_worlds
    ]
    worlds = (*design.main, *design.guarantees)
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
        for world in design.elsewhere
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


def _judged(
    results: EstimatorResults,
    cells: Sequence[EstimatorCell],
    metric: str,
    statement: str,
    limit: float,
) -> Verdict:
    worst = results.mean(results.worst(cells, metric), metric).mean
    return Verdict(statement, f"<= {limit:g}", f"{worst:.2f}", worst <= limit)
