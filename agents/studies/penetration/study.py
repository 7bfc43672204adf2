"""The study of penetration from plan to report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.provenance import check_folder, design_provenance, take_folder
from agents.experiments.reports import write_report
from agents.experiments.runner import Workplace
from agents.figures import LABELS, save_figure
from agents.studies.penetration import tables
from agents.studies.penetration.cell import (
    DELTA,
    EPSILON,
    PACED,
    PRINTED,
    UNKNOWN_SHARES,
    PenetrationCell,
    whole_epsilon,
)
from agents.studies.penetration.figures import draw_arms, draw_errors
from agents.studies.penetration.plan import PenetrationDesign
from agents.studies.penetration.results import PenetrationResults
from agents.studies.penetration.running import run_missing
from dptse_env.release import Detectors

TEMPLATES = Path(__file__).parent


def run(design: PenetrationDesign, place: Workplace, command: str) -> None:
    """Run the cells that are missing, then draw and report.

    Raises:
        ValueError: A value of the design is out of range, or the folder has other results.
    """
    provenance = design_provenance(design)
    recorded = check_folder(place.folder, provenance)
    ledger = Ledger(place.folder / "episodes.csv", PenetrationCell, EpisodeScore)
    if recorded is None or any(
        ledger.lacking(cell, design.traffic_seeds) for cell in design.cells()
    ):
        recorded = take_folder(place.folder, provenance)
        run_missing(design, place, ledger)
    results = PenetrationResults(design, ledger.rows)
    title = "Errors against the share of connected vehicles, 95 % intervals"
    save_figure(draw_errors(results), place.folder / "fig_errors.png", title)
    title = "Queries and detectors together, and either alone, 95 % intervals"
    save_figure(draw_arms(results), place.folder / "fig_arms.png", title)
    write_report(place.folder, TEMPLATES, report(results, recorded, command))


def report(
    results: PenetrationResults, recorded: Mapping[str, Any], command: str
) -> dict[str, Any]:
    """Return the names in the template of the report."""
    design = results.design
    return {
        "design": design,
        "results": results,
        "tables": tables,
        "labels": LABELS,
        "command": command,
        "provenance": recorded,
        "EPSILON": EPSILON,
        "DELTA": DELTA,
        "PRINTED": PRINTED,
        "PACED": PACED,
        "detectors_share": Detectors().part_of_budget(design.base_share),
        "UNKNOWN_SHARES": UNKNOWN_SHARES,
        "whole_epsilon": whole_epsilon(design.base_share),
    }
