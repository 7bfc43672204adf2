"""The reproduction from plan to report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.old_tables import format_range, write_summary
from agents.experiments.provenance import check_folder, design_provenance, take_folder
from agents.experiments.reports import write_report
from agents.experiments.runner import Workplace, missing_tasks, run_task
from agents.experiments.tasks import run_all
from agents.figures import save_figure
from agents.studies.paper import paper_claims, plan, tables
from agents.studies.paper.claims import judge_all
from agents.studies.paper.figures import (
    LAYOUTS,
    OFF_SCALE,
    draw_pictures,
    draw_sweeps,
    draw_times,
    watch_pictures,
)
from agents.studies.paper.paper_claims import CLAIMS, PROJECT_TARGETS
from agents.studies.paper.plan import DELTA, EPSILON, PaperCell, PaperDesign
from agents.studies.paper.results import PaperResults
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
    titles = {
        "fig1_cv_segments.png": f"Error against the number of CV segments, {point}; {seeds}",
        "fig3_epsilon.png": f"Density error against ε, δ = {DELTA:g}, {segments}; {seeds}",
        "fig4_delta.png": f"Density error against δ, ε = {EPSILON:g}, {segments}; {seeds}",
    }
    for name, title in titles.items():
        save_figure(draw_sweeps(results, LAYOUTS[name]), place.folder / name, title)
    title = f"Wall time of predict, update and estimate, one episode at a time, {point}, {segments}"
    save_figure(draw_times(results), place.folder / "fig5_run_time.png", title)
    if not (place.folder / PICTURE).exists():
        first, n_segments = design.traffic_seeds[0], design.picture_segments
        title = f"Density over space and time, traffic seed {first}, {n_segments} CV segments"
        figure = draw_pictures(design, watch_pictures(design, place.records))
        save_figure(figure, place.folder / PICTURE, f"{title}, {point}")


def report(results: PaperResults, recorded: Mapping[str, Any], command: str) -> dict[str, Any]:
    """Return the names in the template of the report."""
    return {
        "results": results,
        "design": results.design,
        "command": command,
        "provenance": recorded,
        "claims": judge_all(CLAIMS, results),
        "targets": judge_all(PROJECT_TARGETS, results),
        "tables": tables,
        "plan": plan,
        "bounds": paper_claims,
        "off_scale": OFF_SCALE,
    }
