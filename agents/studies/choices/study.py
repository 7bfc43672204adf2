"""The study of choices from plan to report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
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
from agents.studies.choices import tables
from agents.studies.choices.cell import HIGHWAY, ROADS, ChoiceCell
from agents.studies.choices.figures import draw_gains
from agents.studies.choices.plan import EPSILON, GAIN, ORACLE, REFERENCE, ChoiceDesign
from agents.studies.choices.results import ChoiceResults
from agents.studies.choices.running import run_missing
from dptse_env.config import parse_seeds

TEMPLATES = Path(__file__).parent


def run(design: ChoiceDesign, place: Workplace, command: str) -> None:
    """Run the cells that are missing, then draw and report.

    Raises:
        FileNotFoundError: A learned policy is missing.
        ValueError: A value of the design is out of range, or the folder has other results.
    """
    provenance = design_provenance(design)
    recorded = check_folder(place.folder, provenance)
    ledger = Ledger(place.folder / "episodes.csv", ChoiceCell, EpisodeScore)
    if recorded is None or any(
        ledger.lacking(cell, design.seeds_of(cell)) for cell in design.cells()
    ):
        recorded = take_folder(place.folder, provenance)
        run_missing(design, place, ledger)
    results = ChoiceResults(design, ledger.rows)
    title = f"Gain of choosing queries over {design.schedule}, 95 % intervals"
    save_figure(draw_gains(results), place.folder / "fig_gains.png", title)
    write_report(place.folder, TEMPLATES, report(results, recorded, command))


def design_provenance(design: ChoiceDesign) -> dict[str, Any]:
    """Return the provenance of a design's results: every road's, and digests of the policies."""
    saved = {each.source: each.sha256 for each in design.saved_policies()}
    cells = dict(zip(design.cells(), design.configs, strict=True))
    first = {(cell.env, cell.traffic): cell for cell in reversed(cells)}
    environments = {
        f"{env} {traffic}": environment_provenance(env, design.schedule, [cells[cell]])
        for (env, traffic), cell in first.items()
    }
    versions = next(iter(environments.values()))["versions"]
    made_with = {"versions": versions, "cells": environments, "policies": saved}
    return results_provenance(made_with, list(cells.values()))


def report(results: ChoiceResults, recorded: Mapping[str, Any], command: str) -> dict[str, Any]:
    """Return the names in the template of the report."""
    design = results.design
    return {
        "design": design,
        "results": results,
        "tables": tables,
        "command": command,
        "provenance": recorded,
        "ORACLE": ORACLE,
        "GAIN": GAIN,
        "REFERENCE": REFERENCE,
        "EPSILON": EPSILON,
        "HIGHWAY": HIGHWAY,
        "roads": ROADS,
        "long_seeds": parse_seeds(design.long_seeds),
        "paying": tables.paying(results),
        "not_paying": tables.not_paying(results),
        "saved": design.saved_policies(),
    }
