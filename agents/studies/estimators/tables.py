"""Tables of the study of estimators, in Markdown."""

from __future__ import annotations

from agents.evaluation.honesty import LEVELS, REGIMES
from agents.experiments.cells import DENSITY, ERROR, SPEED, UnmeasuredError
from agents.experiments.old_tables import format_interval, markdown
from agents.statistics import Interval
from agents.studies.estimators.cell import ESTIMATOR_LABELS, LEARNED, EstimatorCell
from agents.studies.estimators.results import EstimatorResults
from agents.studies.estimators.targets import judge, networks
from agents.studies.estimators.timing import StepTime
from agents.studies.estimators.worlds import WORLDS

_ERRORS = ("error x 1000", "below EKF [%]", "density [veh/km]", "speed [km/h]", "χ²", "covered [%]")


def target_table(results: EstimatorResults) -> str:
    """Return the targets, what the worst training seed reaches, and the verdicts."""
    rows = [
        [each.statement, each.asked, each.reached, "**met**" if each.is_met else "**missed**"]
        for each in judge(results)
    ]
    n = len(results.design.all_networks)
    who = f"the worst of {n} training seeds" if n > 1 else "one training seed"
    return markdown([who, "asked", "reached", ""], rows)


def world_table(results: EstimatorResults, world: str) -> str:
    """Return errors and honesty of every estimator in a world under the base schedule."""
    design = results.design
    rows = []
    for estimator in (*design.quick_estimators, *design.slow_estimators):
        cell = design.cell(world, estimator)
        rows.append([ESTIMATOR_LABELS[estimator], *_errors(results, cell)])
    return markdown(["estimator", *_ERRORS], rows)


def _errors(results: EstimatorResults, cell: EstimatorCell) -> list[str]:
    ekf = results.design.cell(cell.world, "ekf", cell.schedule)
    below = "-" if cell == ekf else format_interval(results.below(cell, ekf))
    chi2 = [f"{results.mean(cell, f'chi2_{name}').mean:.2f}" for name in ("density", "speed")]
    covered = [
        " ".join(f"{results.mean(cell, f'{name}_{level}').mean:.0f}" for level in LEVELS)
        for name in ("density", "speed")
    ]
    means = [format_interval(results.mean(cell, metric)) for metric in (DENSITY, SPEED)]
    error = _tenths(results.mean(cell, ERROR))
    return [error, below, *means, ", ".join(chi2), "; ".join(covered)]


def _tenths(interval: Interval) -> str:
    return f"{interval.mean:.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def schedule_table(results: EstimatorResults, world: str) -> str:
    """Return the error x 1000 of every estimator under every schedule."""
    design = results.design
    schedules = design.schedules_of(world)
    rows = []
    for estimator in (*design.quick_estimators, *design.slow_estimators):
        row = [ESTIMATOR_LABELS[estimator]]
        for schedule in schedules:
            try:
                row.append(_tenths(results.mean(design.cell(world, estimator, schedule), ERROR)))
            except UnmeasuredError:
                row.append("-")
        rows.append(row)
    return markdown(["estimator", *(f"`{name}`" for name in schedules)], rows)


def regime_table(results: EstimatorResults) -> str:
    """Return RMSE of density and speed by regime of traffic, in each main world."""
    rows = []
    for world, each in results.design.main.items():
        for estimator in results.design.quick_estimators:
            cell = results.design.cell(world, estimator)
            parts = [results.regime(cell, regime) for regime in REGIMES]
            row = [f"{density:.1f} / {speed:.1f}" for _, density, speed in parts]
            share = " / ".join(f"{part[0]:.0f}" for part in parts)
            rows.append([each.label, ESTIMATOR_LABELS[estimator], *row, share])
    header = ["world", "estimator", "jam", "front", "free flow", "share of segments [%]"]
    return markdown(header, rows)


def seed_table(results: EstimatorResults) -> str:
    """Return the error x 1000 of every training seed in the worlds of the targets."""
    design, rows = results.design, []
    for world in (*design.main, *design.guarantees):
        cells = networks(design, world)
        errors = [f"{results.mean(cell, ERROR).mean:.1f}" for cell in cells]
        chi2 = [
            f"{results.mean(cell, 'chi2_density').mean:.2f}, "
            f"{results.mean(cell, 'chi2_speed').mean:.2f}"
            for cell in cells
        ]
        both = [f"{error} ({each})" for error, each in zip(errors, chi2, strict=True)]
        rows.append([WORLDS[world].label, *both])
    names = [f"network {k}" for k in range(len(design.all_networks))]
    return markdown(["error x 1000 (χ² of density, speed)", *names], rows)


def elsewhere_table(results: EstimatorResults) -> str:
    """Return errors away from the base world, and by how much the network's are smaller."""
    design, rows = results.design, []
    for world, each in design.elsewhere.items():
        cells = {name: design.cell(world, name) for name in design.moved_estimators}
        errors = [_tenths(results.mean(cell, ERROR)) for cell in cells.values()]
        below = format_interval(results.below(cells[LEARNED], cells["ekf"]))
        chi2 = [
            f"{results.mean(cells[LEARNED], f'chi2_{name}').mean:.2f}"
            for name in ("density", "speed")
        ]
        rows.append([each.label, *errors, below, ", ".join(chi2)])
    names = [ESTIMATOR_LABELS[name] for name in design.moved_estimators]
    return markdown(
        ["`PrivateHighway-v1` but for", *names, "recurrent below EKF [%]", "χ² of recurrent"], rows
    )


def time_table(times: list[StepTime]) -> str:
    """Return the time of a step of each estimator over that of the EKF."""
    rows = [
        [ESTIMATOR_LABELS[each.estimator], f"{each.ratio:.2f} [{each.low:.2f}, {each.high:.2f}]"]
        for each in times
    ]
    return markdown(["estimator", "time of a step over the EKF's"], rows)
