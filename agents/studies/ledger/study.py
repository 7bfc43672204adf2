"""The study of ledgers from plan to report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.evaluation.contributions import LedgerScore, TripSums
from agents.experiments.cells import METRICS
from agents.experiments.ledger import Ledger
from agents.experiments.old_tables import write_summary
from agents.experiments.provenance import check_folder, design_provenance, take_folder
from agents.experiments.reports import write_report
from agents.experiments.runner import Workplace
from agents.experiments.tasks import run_all
from agents.figures import save_figure
from agents.studies.ledger import sentences, tables
from agents.studies.ledger.cell import CAPPED, REFERENCE, LedgerCell
from agents.studies.ledger.figures import draw_epsilon, draw_ladder, draw_ledgers
from agents.studies.ledger.plan import LedgerDesign, Named
from agents.studies.ledger.results import EXHAUSTED, REFUSED, LedgerResults
from agents.studies.ledger.running import lacking_tasks, score_cell, watch_cell

TEMPLATES = Path(__file__).parent
STARING = "largest-variance"
"""A schedule that keeps querying the same places."""


def run(design: LedgerDesign, place: Workplace, command: str) -> None:
    """Run the cells that are missing, then draw and report.

    Raises:
        ValueError: A value of the design is out of range, or the folder has other results.
    """
    # Every environment is made here: bad input shows before anything is run or written.
    provenance = design_provenance(design)
    recorded = check_folder(place.folder, provenance)
    episodes = Ledger(place.folder / "episodes.csv", LedgerCell, LedgerScore)
    trips = Ledger(place.folder / "trips.csv", LedgerCell, TripSums)
    unscored = lacking_tasks(design, design.cells(), episodes, place)
    unwatched = lacking_tasks(design, (each.cell for each in design.watched), trips, place)
    if unscored or unwatched or recorded is None:
        recorded = take_folder(place.folder, provenance)
        place.record(design.configs[0].corridor, design.traffic_seeds)
        run_all(unscored, episodes, place.engine, score_cell)
        run_all(unwatched, trips, place.engine, watch_cell)
    results = LedgerResults(design, episodes.rows, trips.rows)
    draw(place.folder, results)
    write_report(place.folder, TEMPLATES, report(results, recorded, command))
    write_summary(place.folder / "summary.csv", results, (REFUSED, EXHAUSTED))


def shown_trips(design: LedgerDesign) -> list[Named]:
    """Return the watched cells that the figure shows: few enough to tell them apart."""
    names = [design.schedule, REFERENCE, *(n for n in design.schedules if n == STARING)]
    full = design.cell(pace=design.paces[-1])
    return [
        *(Named(f"`paced`, `{name}`", design.cell(schedule=name)) for name in names),
        Named(f"`paced`, `{design.schedule}`, pace {full.pace:g}", full),
        *(Named(f"`capped`, `{name}`", design.cell(CAPPED, schedule=name)) for name in names[:2]),
    ]


def draw(folder: Path, results: LedgerResults) -> None:
    """Save the figures."""
    design = results.design
    seeds = f"{len(design.traffic_seeds)} traffic seeds, 95 % intervals"
    title = f"Error against ε, EKF with demand states, schedule {design.schedule}; {seeds}"
    save_figure(draw_epsilon(results), folder / "fig_epsilon.png", title)
    title = f"(ε, δ) = ({design.epsilon:g}, {design.delta:g}), whole trip, replaced; {seeds}"
    save_figure(draw_ladder(results), folder / "fig_ladder.png", title)
    title = f"Who runs out (true traffic, for evaluation only); {seeds}"
    figure = draw_ledgers(results, shown_trips(design))
    save_figure(figure, folder / "fig_ledgers.png", title)


def report(results: LedgerResults, recorded: Mapping[str, Any], command: str) -> dict[str, Any]:
    """Return the names in the template of the report."""
    design = results.design
    return {
        "design": design,
        "results": results,
        "tables": tables,
        "command": command,
        "provenance": recorded,
        "METRICS": METRICS,
        "ladder": sentences.ladder_numbers(results),
        "equal_errors": sentences.equal_errors(results),
        "variants": sentences.variant_numbers(results),
        "settings": {name: sentences.best_setting(results, name) for name in sentences.SETTINGS},
        "policies": sentences.policy_numbers(results),
        "refusals": sentences.refusal_numbers(results),
        "shown": shown_trips(design),
        "shortfalls": sentences.shortfalls(results),
    }
