"""The study of estimators from plan to report."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.evaluation.honesty import JUMP, LEVELS, SLOW, EstimatorScore
from agents.experiments.ledger import Ledger
from agents.experiments.provenance import (
    check_folder,
    environment_provenance,
    results_provenance,
    take_folder,
)
from agents.experiments.reports import write_report
from agents.experiments.runner import Workplace
from agents.figures import save_figure
from agents.files import write_json
from agents.studies.estimators import tables, targets
from agents.studies.estimators.cell import EstimatorCell
from agents.studies.estimators.figures import draw_coverage, draw_elsewhere, draw_worlds
from agents.studies.estimators.floors import Floor, floors
from agents.studies.estimators.plan import OWN, EstimatorDesign
from agents.studies.estimators.results import EstimatorResults
from agents.studies.estimators.running import run_missing, worlds_of
from agents.studies.estimators.timing import StepTime, measure
from dptse_env.config import parse_seeds

TEMPLATES = Path(__file__).parent
TIMED = "capped"
"""World in which steps are timed, where it is among those that are run."""
MEASURED_ONCE = "times.json"
"""Times of steps, and floors; measured again where the file is gone."""


def run(design: EstimatorDesign, place: Workplace, command: str) -> None:
    """Run the cells that are missing, then draw and report.

    Raises:
        ValueError: A value of the design is out of range, or the folder has other results.
    """
    provenance = design_provenance(design)
    recorded = check_folder(place.folder, provenance)
    ledger = Ledger(place.folder / "episodes.csv", EstimatorCell, EstimatorScore)
    if recorded is None or any(
        ledger.lacking(cell, design.seeds_of(cell)) for cell in design.cells()
    ):
        recorded = take_folder(place.folder, provenance)
        run_missing(design, place, ledger)
    times, grounds = _measured_once(design, place)
    results = EstimatorResults(design, ledger.rows)
    draw(place.folder, results)
    content = report(results, recorded, command)
    write_report(place.folder, TEMPLATES, {**content, "times": times, "floors": grounds})


def design_provenance(design: EstimatorDesign) -> dict[str, Any]:
    """Return the provenance of a design's results: every world's, and digests of the networks."""
    cells = dict(zip(design.cells(), design.configs, strict=True))
    worlds = {
        world: environment_provenance(
            each.place.env, design.schedule, [cells[each]]
        )
        for world in worlds_of(cells)
        for each in [next(cell for cell in cells if cell.world == world)]
    }  # fmt: skip
    networks = {name: each.sha256 for name, each in design.saved_networks().items()}
    settings = [config for cell, config in cells.items() if not cell.weights]
    made_with = {"cells": worlds, "networks": networks, "fit_seeds": design.fit_seeds}
    return results_provenance(made_with, settings)


def _measured_once(
    design: EstimatorDesign, place: Workplace
) -> tuple[list[StepTime], dict[str, list[Floor]]]:
    path = place.folder / MEASURED_ONCE
    if not path.exists():
        by_traffic = {
            design.config(design.cell(world, "ekf")).corridor: world
            for world in reversed(design.main)
        }
        found = {
            world: floors(design, world, place.records)
            for world in design.main
            if world in by_traffic.values()
        }
        times = [
            dataclasses.asdict(each) for each in measure(design, _timed(design), place.records)
        ]
        write_json(path, {"times": times, "floors": found})
    content = json.loads(path.read_text(encoding="utf-8"))
    kept = {world: [Floor(*each) for each in rows] for world, rows in content["floors"].items()}
    return [StepTime(**each) for each in content["times"]], kept


def _timed(design: EstimatorDesign) -> str:
    """Return the world in which steps are timed."""
    return TIMED if TIMED in design.main else next(iter(design.main))


def draw(folder: Path, results: EstimatorResults) -> None:
    """Save the figures."""
    design = results.design
    seeds = f"{len(design.traffic_seeds)} traffic seeds, 95 % intervals"
    title = f"Error under the schedule {design.schedule}; {seeds}"
    save_figure(draw_worlds(results), folder / "fig_estimators.png", title)
    save_figure(draw_coverage(results), folder / "fig_coverage.png", "Coverage of intervals")
    if design.elsewhere:
        title = "The recurrent network where things differ from PrivateHighway-v1"
        save_figure(draw_elsewhere(results), folder / "fig_elsewhere.png", title)


def report(results: EstimatorResults, recorded: Mapping[str, Any], command: str) -> dict[str, Any]:
    """Return the names in the template of the report."""
    design = results.design
    return {
        "design": design,
        "results": results,
        "tables": tables,
        "command": command,
        "provenance": recorded,
        "LEVELS": LEVELS,
        "JUMP": JUMP,
        "SLOW": SLOW,
        "OWN": OWN,
        "road": design.configs[0].corridor.name,
        "timed": design.main[_timed(design)].label,
        "missed": []
        if design.corridor
        else [each for each in targets.judge(results) if not each.is_met],
        "n_elsewhere": len(parse_seeds(design.elsewhere_seeds)),
        "cards": {
            name: each.card["training"]
            for name, each in design.saved_networks().items()
            if name.startswith(design.weights)
        },
    }
