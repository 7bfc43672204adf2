"""Tables of the study of privacy, in Markdown."""

from __future__ import annotations

from agents.experiments import old_tables as tables
from agents.experiments.cells import METRICS
from agents.experiments.old_tables import (
    compared_errors,
    compared_header,
    format_interval,
    format_number,
    markdown,
)
from agents.figures import LABELS
from agents.studies.privacy.plan import BOUNDARY_MODES
from agents.studies.privacy.results import PrivacyResults


def epsilon_table(results: PrivacyResults, estimator: str, metric: str) -> str:
    """Return errors by protection (rows) and epsilon (columns)."""
    design = results.design
    rows = []
    for protection in (*design.guaranteed, *design.printed):
        cells = design.along_epsilon(estimator, protection)
        means = [format_interval(results.mean(cell, metric)) for cell in cells]
        rows.append([str(protection), *means])
    return markdown(["protection", *(f"ε = {value:g}" for value in design.epsilons)], rows)


def noise_table(results: PrivacyResults) -> str:
    """Return the noise of a density and of a mean speed or flow behind each cell."""
    design = results.design
    rows = []
    for protection in (*design.guaranteed, *design.printed):
        unit = "km/h" if protection in design.printed else "veh/h"
        accounts = results.accounts[protection]
        noise = [f"{a.density_std:.3g} veh/km; {a.second_std:.3g} {unit}" for a in accounts]
        rows.append([str(protection), *noise])
    return markdown(["protection", *(f"ε = {value:g}" for value in design.epsilons)], rows)


def claimed_table(results: PrivacyResults) -> str:
    """Return epsilon claimed, composed and met of the paper's noise."""
    cap, horizon = results.meetings
    met = sorted({cap, results.longest_trip, horizon})
    rows = []
    for protection in results.design.printed:
        for account in results.accounts[protection]:
            values = [account.composed, *(account.met[n] for n in met), account.alone[cap]]
            rows.append([str(protection), f"{account.claimed:g}", *map(format_number, values)])
    header = ["noise", "claimed", "composed", *(f"met {n} times, at least" for n in met)]
    return markdown([*header, f"met {cap} times, alone and standing"], rows)


def cost_table(results: PrivacyResults, estimator: str) -> str:
    """Return by how much a guarantee's errors exceed those of the paper's noise, paired."""
    design = results.design
    rows = []
    for value in design.epsilons:
        cell = design.cell(estimator, epsilon=value)
        row = [f"{value:g}"]
        for protection in design.printed:
            reference = design.cell(estimator, protection, epsilon=value)
            row += [format_interval(results.difference(cell, reference, m)) for m in METRICS]
        rows.append(row)
    header = ["ε"]
    for protection in design.printed:
        header += [f"{name} over {protection} [{unit}]" for name, unit in METRICS.values()]
    return markdown(header, rows)


def modes_table(results: PrivacyResults) -> str:
    """Return errors by boundary mode, and the paired difference to the nominal one."""
    design = results.design
    rows = []
    for name in design.all_estimators:
        nominal = design.cell(name, boundary_inputs=BOUNDARY_MODES[0])
        for mode in BOUNDARY_MODES:
            cell = design.cell(name, boundary_inputs=mode)
            rows.append([LABELS[name], mode, *compared_errors(results, cell, nominal)])
    return markdown(["estimator", "boundary inputs", *compared_header("nominal")], rows)


def bandwidth_table(results: PrivacyResults) -> str:
    """Return errors by bandwidth, and the paired difference to the base value."""
    design = results.design
    rows = []
    for name in design.estimators:
        base = design.cell(name)
        for cell in design.along_bandwidth(name):
            rows.append([LABELS[name], str(cell.bandwidth), *compared_errors(results, cell, base)])
    header = ["estimator", "queried a second", *compared_header(f"{design.bandwidth}")]
    return markdown(header, rows)


def health_table(results: PrivacyResults) -> str:
    """Return the seconds that each estimator lost, over all its episodes."""
    cells = results.design.cells()
    return tables.health_table(
        ["estimator"],
        {
            (LABELS[name],): results.episodes(*(cell for cell in cells if cell.estimator == name))
            for name in results.design.all_estimators
        },
    )
