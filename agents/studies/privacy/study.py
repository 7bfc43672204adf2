"""The study of privacy from plan to report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.cells import DENSITY, METRICS, SPEED
from agents.experiments.ledger import Ledger
from agents.experiments.old_tables import write_summary
from agents.experiments.provenance import check_folder, design_provenance, take_folder
from agents.experiments.reports import write_report
from agents.experiments.runner import Workplace, missing_tasks, run_task
from agents.experiments.tasks import run_all
from agents.figures import LABELS, save_figure
from agents.studies.privacy import tables
from agents.studies.privacy.account import Traffic, Trips, make_account, measure_trips
from agents.studies.privacy.figures import draw_claimed, draw_epsilon, draw_modes
from agents.studies.privacy.plan import OPEN_LOOP, PrivacyCell, PrivacyDesign
from agents.studies.privacy.results import PrivacyResults

TEMPLATES = Path(__file__).parent


def run(design: PrivacyDesign, place: Workplace, command: str) -> None:
    """Run the episodes that are missing, then draw and report.

    Raises:
        ValueError: A value of the design is out of range, or the folder has other results.
    """
    # Every environment is made here: bad input shows before anything is run or written.
    provenance = design_provenance(design)
    recorded = check_folder(place.folder, provenance)
    episodes = Ledger(place.folder / "episodes.csv", PrivacyCell, EpisodeScore)
    tasks = missing_tasks(design, episodes, place.records)
    if tasks or recorded is None:
        recorded = take_folder(place.folder, provenance)
        place.record(design.configs[0].corridor, design.traffic_seeds)
        run_all(tasks, episodes, place.engine, run_task)
    results = read_results(design, place, episodes)
    draw(place.folder, results)
    write_report(place.folder, TEMPLATES, report(results, recorded, command))
    write_summary(place.folder / "summary.csv", results)


def read_results(
    design: PrivacyDesign, place: Workplace, episodes: Ledger[PrivacyCell, EpisodeScore]
) -> PrivacyResults:
    """Put scores together with the guarantee behind their noise and with the trips.

    Lengths of trips are measured where the folder does not have them yet.
    """
    config = design.configs[0]
    key = Traffic(config.corridor.digest)
    trips = Ledger(place.folder / "trips.csv", Traffic, Trips)
    lacking = trips.lacking(key, design.traffic_seeds)
    if lacking:
        place.record(config.corridor, lacking)
        library = place.records
        trips.append(key, [measure_trips(config.corridor, seed, library) for seed in lacking])
    lengths = np.concatenate([trips.rows[key, seed].lengths for seed in design.traffic_seeds])
    horizon = config.horizon_steps
    meetings = (min(design.cap, horizon), int(lengths.max()), horizon)
    accounts = {
        protection: [
            make_account(design, cell, meetings)
            for cell in design.along_epsilon(design.estimators[0], protection)
        ]
        for protection in (*design.guaranteed, *design.printed)
    }
    return PrivacyResults(design, episodes.rows, accounts, lengths, horizon)


def draw(folder: Path, results: PrivacyResults) -> None:
    """Save the figures."""
    design = results.design
    seeds = f"{len(design.traffic_seeds)} traffic seeds, 95 % intervals"
    segments = f"{design.bandwidth} segments a second"
    title = f"The price of a guarantee: error against ε, δ = {design.delta:g}, {segments}; {seeds}"
    save_figure(draw_epsilon(results), folder / "fig_epsilon.png", title)
    title = f"Error at ε = {design.epsilon:g}, C = {design.cap}; {seeds}"
    save_figure(draw_modes(results), folder / "fig_modes.png", title)
    title = f"The guarantee of the paper's noise, δ = {design.delta:g}; {seeds}"
    save_figure(draw_claimed(results), folder / "fig_claimed.png", title)


def estimator_numbers(results: PrivacyResults, name: str) -> dict[str, Any]:
    """Return the numbers of the report about one estimator."""
    design = results.design
    base, open_loop = design.cell(name), design.cell(OPEN_LOOP)
    low, high = design.guaranteed[1], design.guaranteed[-2]
    few, many = design.bandwidths[0], design.bandwidths[-1]

    def beats_open_loop(metric: str) -> list[float]:
        return [
            value
            for value in design.epsilons
            if results.difference(design.cell(name, epsilon=value), open_loop, metric).high < 0.0
        ]

    return {
        "name": name,
        "label": LABELS[name],
        "density": results.mean(base, DENSITY),
        "speed": results.mean(base, SPEED),
        "over_printed": [
            (printed, results.change(base, design.cell(name, printed)))
            for printed in design.printed
        ],
        "better_density": beats_open_loop(DENSITY),
        "better_speed": beats_open_loop(SPEED),
        "low_cap": low.cap,
        "high_cap": high.cap,
        "cap_change": results.change(design.cell(name, high), design.cell(name, low)),
        "mode_changes": [
            (mode, results.change(design.cell(name, boundary_inputs=mode), base))
            for mode in ("private", "true")
        ],
        "few": few,
        "many": many,
        "bandwidth_change": results.change(
            design.cell(name, bandwidth=many), design.cell(name, bandwidth=few)
        ),
    }


def report(results: PrivacyResults, recorded: Mapping[str, Any], command: str) -> dict[str, Any]:
    """Return the names in the template of the report."""
    design = results.design
    nearest = min(range(len(design.epsilons)), key=lambda k: abs(np.log(design.epsilons[k])))
    cap, horizon = results.meetings
    median, percentile_99 = np.quantile(results.trips, (0.5, 0.99))
    open_loop = {
        mode: [results.mean(design.cell(OPEN_LOOP, boundary_inputs=mode), m) for m in METRICS]
        for mode in ("nominal", "true")
    }
    return {
        "design": design,
        "command": command,
        "METRICS": METRICS,
        "estimators": [estimator_numbers(results, name) for name in design.estimators],
        "printed": [(kind, results.accounts[kind][nearest]) for kind in design.printed],
        "meetings": {"cap": cap, "longest": results.longest_trip, "horizon": horizon},
        "trips": {"median": median, "high": percentile_99, "n_vehicles": len(results.trips)},
        "open_loop": open_loop,
        "results": results,
        "tables": tables,
        "provenance": recorded,
    }
