"""The reproduction from plan to report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
from agents.evaluation.figures import save_figure
from agents.experiments.cells import DENSITY, SPEED
from agents.experiments.engine import run_all
from agents.experiments.ledger import Ledger
from agents.experiments.provenance import check_folder, design_provenance, take_folder
from agents.experiments.reports import write_report
from agents.experiments.runner import Workplace, missing_tasks, run_task
from agents.experiments.tables import format_range, settings_table, versions_table, write_summary
from agents.studies.paper.claims import judge_all
from agents.studies.paper.figures import OFF_SCALE, draw_figures, draw_pictures, watch_pictures
from agents.studies.paper.paper_claims import CLAIMS, CLOSE, PROJECT_TARGETS, SIMILAR, SMALL
from agents.studies.paper.plan import DELTA, EPSILON, PaperCell, PaperDesign
from agents.studies.paper.results import PaperResults
from agents.studies.paper.tables import (
    base_table,
    grid_table,
    health_table,
    parts_table,
    time_table,
    verdict_table,
)
from agents.studies.paper.timing import StepTime, time_all, untimed

TEMPLATES = Path(__file__).parent
PICTURE = "fig2_space_time.png"


def run(design: PaperDesign, place: Workplace, command: str) -> None:
    """Run the episodes that are missing, then draw, judge and report.

    Result 2 shows episodes, so its picture is drawn again only if it is missing or anything was
    run.

    Raises:
        ValueError: A value of the design is out of range, or the folder has other results.
    """
    # Every environment is made here: bad input shows before anything is run or written.
    provenance = design_provenance(design)
    recorded = check_folder(place.folder, provenance)
    episodes = Ledger(place.folder / "episodes.csv", PaperCell, EpisodeScore)
    times = Ledger(place.folder / "run_time.csv", PaperCell, StepTime)
    tasks = missing_tasks(design, episodes, place.records)
    if tasks or untimed(design, times) or recorded is None:
        recorded = take_folder(place.folder, provenance)
        (place.folder / PICTURE).unlink(missing_ok=True)
        place.record(design.configs[0].corridor, design.traffic_seeds)
        run_all(tasks, episodes, place.engine, run_task)
        time_all(design, times, place.records)
    results = PaperResults(design, episodes.rows, times.rows)
    draw(place, results)
    write_report(place.folder, TEMPLATES, report(results, recorded, command))
    write_summary(place.folder / "summary.csv", results)


def draw(place: Workplace, results: PaperResults) -> None:
    """Save the five figures."""
    design, point = results.design, f"(ε, δ) = ({EPSILON:g}, {DELTA:g})"
    seeds = f"traffic seeds {format_range(design.traffic_seeds)}, 95 % intervals"
    segments = f"{design.privacy_segments} CV segments"
    titles = [
        f"Error against the number of CV segments, {point}; {seeds}",
        f"Density error against ε, δ = {DELTA:g}, {segments}; {seeds}",
        f"Density error against δ, ε = {EPSILON:g}, {segments}; {seeds}",
        f"Wall time of predict, update and estimate, one episode at a time, {point}, {segments}",
    ]
    draw_figures(place.folder, results, titles)
    if not (place.folder / PICTURE).exists():
        first, n_segments = design.traffic_seeds[0], design.picture_segments
        title = f"Density over space and time, traffic seed {first}, {n_segments} CV segments"
        figure = draw_pictures(design, watch_pictures(design, place.records))
        save_figure(figure, place.folder / PICTURE, f"{title}, {point}")


def report(results: PaperResults, recorded: Mapping[str, Any], command: str) -> dict[str, Any]:
    """Return the tables and numbers of the report."""
    claims, targets = judge_all(CLAIMS, results), judge_all(PROJECT_TARGETS, results)
    details = [(outcomes[0].claim, parts_table(outcomes)) for outcomes in (*claims, *targets)]
    return {
        "design": results.design,
        "n_cells": len(results.design.cells()),
        "command": command,
        "epsilon": EPSILON,
        "delta": DELTA,
        "close": CLOSE,
        "small": SMALL,
        "similar": SIMILAR,
        "off_scale": OFF_SCALE,
        "claims_table": verdict_table(claims),
        "targets_table": verdict_table(targets),
        "density_table": base_table(results, DENSITY),
        "speed_table": base_table(results, SPEED),
        "time_table": time_table(results),
        "health_table": health_table(results),
        "details": details,
        "grid_table": grid_table(results),
        "versions_table": versions_table(recorded["made_with"]["versions"], recorded),
        "settings_table": settings_table(recorded),
        "provenance": recorded,
    }
