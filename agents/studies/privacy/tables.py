"""Tables of the study, in Markdown, and the summary as CSV."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

from agents.studies.paper.measures import LABELS
from agents.studies.paper.tables import markdown, shown
from agents.studies.privacy.plan import BOUNDARY_MODES, Cell
from agents.studies.privacy.results import DENSITY, METRICS, SPEED, Measured


def epsilon_table(measured: Measured, estimator: str, metric: str) -> str:
    """Return errors by protection (rows) and epsilon asked for (columns)."""
    design = measured.design
    rows = [
        [
            str(protection),
            *(
                shown(measured.mean(cell, metric))
                for cell in design.along_epsilon(estimator, protection)
            ),
        ]
        for protection in (*design.guaranteed, *design.printed)
    ]
    return markdown(["protection", *(f"ε = {value:g}" for value in design.epsilons)], rows)


def noise_table(measured: Measured) -> str:
    """Return the noise of a density and of a mean speed or flow behind each cell."""
    design = measured.design
    rows = []
    for protection in (*design.guaranteed, *design.printed):
        unit = "km/h" if protection in design.printed else "veh/h"
        accounts = measured.accounts[protection]
        noise = [f"{own.density_std:.3g} veh/km; {own.second_std:.3g} {unit}" for own in accounts]
        rows.append([str(protection), *noise])
    return markdown(["protection", *(f"ε = {value:g}" for value in design.epsilons)], rows)


def claimed_table(measured: Measured) -> str:
    """Return epsilon claimed, composed and met of the paper's noise."""
    cap, horizon = measured.meetings
    longest = int(measured.trips.max())
    met = sorted({cap, longest, horizon})
    rows = []
    for protection in measured.design.printed:
        for own in measured.accounts[protection]:
            values = [own.composed, *(own.met[n] for n in met), own.alone[cap]]
            rows.append([str(protection), f"{own.claimed:g}", *map(number, values)])
    header = ["noise", "claimed", "composed", *(f"met {n} times, at least" for n in met)]
    header.append(f"met {cap} times, alone and standing")
    return markdown(header, rows)


def number(value: float) -> str:
    """Return three significant digits without an exponent."""
    return f"{float(f'{value:.3g}'):g}" if abs(value) < 1e5 else f"{value:,.0f}"


def cost_table(measured: Measured, estimator: str) -> str:
    """Return by how much a guarantee's errors exceed those of the paper's noise, paired."""
    design = measured.design
    rows = []
    for value in design.epsilons:
        cell = design.cell(estimator, epsilon=value)
        row = [f"{value:g}"]
        for protection in design.printed:
            reference = design.cell(estimator, protection, epsilon=value)
            row += [shown(measured.difference(cell, reference, metric)) for metric in METRICS]
        rows.append(row)
    header = ["ε asked for"]
    for protection in design.printed:
        header += [f"{name} over {protection} [{unit}]" for name, unit in METRICS.values()]
    return markdown(header, rows)


def modes_table(measured: Measured) -> str:
    """Return errors by boundary mode, and the paired difference to the nominal one."""
    design = measured.design
    rows = []
    for name in design.all_estimators:
        nominal = design.cell(name, boundary_inputs=BOUNDARY_MODES[0])
        for mode in BOUNDARY_MODES:
            cell = design.cell(name, boundary_inputs=mode)
            rows.append([LABELS[name], mode, *_compared(measured, cell, nominal)])
    return markdown(["estimator", "boundary inputs", *_header("nominal")], rows)


def bandwidth_table(measured: Measured) -> str:
    """Return errors by bandwidth, and the paired difference to the base one."""
    design = measured.design
    rows = []
    for name in design.estimators:
        base = design.cell(name)
        for cell in design.along_bandwidth(name):
            rows.append([LABELS[name], str(cell.bandwidth), *_compared(measured, cell, base)])
    return markdown(["estimator", "queried a second", *_header(str(design.bandwidth))], rows)


def _header(reference: str) -> list[str]:
    header = []
    for name, unit in METRICS.values():
        header += [f"{name} RMSE [{unit}]", f"against {reference}"]
    return header


def _compared(measured: Measured, cell: Cell, reference: Cell) -> list[str]:
    row = []
    for metric in METRICS:
        row.append(shown(measured.mean(cell, metric)))
        same = cell == reference
        row.append("-" if same else shown(measured.difference(cell, reference, metric)))
    return row


def health_table(measured: Measured) -> str:
    """Return seconds lost by each estimator, over all its episodes."""
    design = measured.design
    rows = []
    for name in design.all_estimators:
        cells = [cell for cell in design.cells() if cell.estimator == name]
        lost = [
            f"{sum(float(measured.values(cell, kind).sum()) for cell in cells):.0f}"
            for kind in ("n_diverged", "n_fallback")
        ]
        rows.append([LABELS[name], *lost, str(len(cells) * len(design.seeds))])
    return markdown(["estimator", "started over [s]", "kept the prediction [s]", "episodes"], rows)


def write_summary(path: Path, measured: Measured) -> None:
    """Write means with intervals as CSV, one row for each cell."""
    columns = [field.name for field in dataclasses.fields(Cell)] + ["n_seeds"]
    for metric, unit in ((DENSITY, "veh_km"), (SPEED, "km_h")):
        columns += [f"{metric}_{unit}", f"{metric}_low", f"{metric}_high"]
    columns += ["reward", "reward_low", "reward_high", "n_diverged", "n_fallback"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for cell in sorted(measured.design.cells(), key=dataclasses.astuple):
            row: list[Any] = [*dataclasses.astuple(cell), len(measured.design.seeds)]
            for metric in (DENSITY, SPEED, "reward"):
                own = measured.mean(cell, metric)
                row += [f"{value:.6g}" for value in (own.mean, own.low, own.high)]
            row += [measured.values(cell, f"n_{kind}").sum() for kind in ("diverged", "fallback")]
            writer.writerow(row)
