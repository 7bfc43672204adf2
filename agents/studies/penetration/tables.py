"""Tables of the study of penetration."""

from __future__ import annotations

import itertools

from agents.experiments.cells import DENSITY, ERROR, SPEED
from agents.experiments.old_tables import markdown
from agents.figures import LABELS
from agents.statistics import Interval
from agents.studies.penetration.cell import (
    COUNT,
    DETECTORS,
    ESTIMATED,
    FACTORS,
    GUARANTEED,
    HEALTHY,
    MISREPORTING,
    MIXED,
    QUERIES,
    REPORTED,
    TESTED,
    TRUCKS,
    WHOLE,
    WITHOUT,
    PenetrationCell,
)
from agents.studies.penetration.results import PenetrationResults

ARMS = {
    QUERIES: "queries alone",
    DETECTORS: "detectors alone",
    WHOLE: "detectors alone with the whole budget",
}


def errors_table(results: PenetrationResults, release: str) -> str:
    """Return errors of density and speed by share, and those of detectors alone."""
    design = results.design
    rows = []
    for estimator in design.estimators:
        cells = [design.fused(release, estimator, share) for share in design.shares]
        cells.append(design.alone(release, estimator, DETECTORS))
        if release in GUARANTEED:
            cells.append(design.alone(release, estimator))
        rows.append([LABELS[estimator], *(_errors(results, cell) for cell in cells)])
    alone = ["detectors alone"]
    if release in GUARANTEED:
        alone = ["detectors alone, their part of the budget", "the whole budget"]
    return markdown(["", *map(share_label, design.shares), *alone], rows)


def arms_table(results: PenetrationResults) -> str:
    """Return at the base share the error of both kinds of sensors, and what they gain on either."""
    design = results.design
    rows = []
    for pair in itertools.product(design.releases, design.estimators):
        fused = design.fused(*pair)
        others = results.alternatives(*pair)
        gains = {name: gain(results.below(fused, other)) for name, other in others.items()}
        columns = (gains.get(name, "same") for name in ARMS)
        rows.append([_name(*pair), _error(results, fused), *columns])
    header = ["", "both, error x 1000", *(f"below {arm} [%]" for arm in ARMS.values())]
    return markdown(header, rows)


def worth_table(results: PenetrationResults) -> str:
    """Return by share what queries beside detectors gain on detectors with the whole budget."""
    design = results.design
    rows = []
    for release in design.releases:
        for estimator in design.estimators:
            alone = design.alone(release, estimator)
            gains = [
                gain(results.below(design.fused(release, estimator, share), alone))
                for share in design.shares
            ]
            least = results.worth(release, estimator)
            rows.append(
                [
                    _name(release, estimator),
                    *gains,
                    "never" if least is None else share_label(least),
                ]
            )
    return markdown(["", *map(share_label, design.shares), "for certain from"], rows)


def queries_table(results: PenetrationResults) -> str:
    """Return by share what detectors beside queries gain on queries with the whole budget."""
    design = results.design
    rows = [
        [
            _name(release, estimator),
            *(
                gain(
                    results.below(
                        design.fused(release, estimator, share),
                        design.queries(release, estimator, share),
                    )
                )
                for share in design.shares
            ),
        ]
        for release in design.releases
        for estimator in design.estimators
    ]
    return markdown(["", *map(share_label, design.shares)], rows)


def reports_table(results: PenetrationResults, release: str) -> str:
    """Return errors by share with densities from counts, and what other sources gain on them."""
    design = results.design
    rows = []
    for estimator in design.report_estimators:
        cells = [design.fused(release, estimator, share) for share in design.shares]
        errors = (f"{results.mean(cell, ERROR).mean:.1f}" for cell in cells)
        rows.append([LABELS[estimator], COUNT, *errors])
        for source in REPORTED:
            gains = (
                gain(results.below(design.reported(release, estimator, cell.share, source), cell))
                for cell in cells
            )
            rows.append(["", source, *gains])
    return markdown(["", "density from", *map(share_label, design.shares)], rows)


def classes_table(results: PenetrationResults) -> str:
    """Return errors where a tenth of the vehicles are connected at random, or all trucks are."""
    design = results.design
    rows = []
    for release in design.printed_and_paced:
        for estimator in design.report_estimators:
            for source in (COUNT, *REPORTED):
                mixed, trucks = (
                    design.classes(release, estimator, world, source) for world in (MIXED, TRUCKS)
                )
                rows.append([
                    _name(release, estimator),
                    source,
                    _errors(results, mixed),
                    _errors(results, trucks),
                    percent(results.loss([trucks], mixed)),
                ])  # fmt: skip
    header = ["", "density from", "a tenth at random", "all trucks", "error of trucks above [%]"]
    return markdown(header, rows)


def policies_table(results: PenetrationResults, estimator: str) -> str:
    """Return errors of schedules by share, and how they compare with the base schedule's."""
    design = results.design
    rows = []
    for policy in design.policies_of(estimator):
        row = [f"`{policy}`"]
        for share in reversed(design.policy_shares):
            cell = design.chosen(estimator, share, policy)
            base = design.chosen(estimator, share, design.schedule)
            error = f"{results.mean(cell, ERROR).mean:.1f}"
            below = "" if cell == base else f", {gain(results.below(cell, base))}"
            row.append(error + below)
        rows.append(row)
    return markdown(["", *map(share_label, reversed(design.policy_shares))], rows)


def ranking(results: PenetrationResults, estimator: str, share: float) -> str:
    """Return the schedules from the least error to the largest."""
    design = results.design
    errors = {
        policy: results.mean(design.chosen(estimator, share, policy), ERROR).mean
        for policy in design.policies_of(estimator)
    }
    return ", ".join(f"`{policy}`" for policy in sorted(errors, key=lambda each: errors[each]))


def unknown_table(results: PenetrationResults) -> str:
    """Return errors with the middle of an unknown share published, and with it estimated."""
    design = results.design
    rows = []
    for release in design.printed_and_paced:
        for estimator in design.estimators:
            published = design.unknown(release, estimator)
            estimated = design.unknown(release, estimator, ESTIMATED)
            rows.append([
                _name(release, estimator),
                _errors(results, published),
                _errors(results, estimated),
                gain(results.below(estimated, published)),
            ])  # fmt: skip
    header = ["", "published, the middle", "estimated", "error of the estimated below [%]"]
    return markdown(header, rows)


def faults_table(results: PenetrationResults) -> str:
    """Return by how much errors lie above those of healthy sensors [%], without and with a test."""
    design = results.design
    rows = []
    for release in design.printed_and_paced:
        for estimator in design.fault_estimators:
            (healthy,) = design.faulty(release, estimator, (HEALTHY,))
            row = [_name(release, estimator), _error(results, healthy)]
            for worlds, fusion in (
                (tuple(FACTORS), ""),
                (tuple(FACTORS), TESTED),
                ((WITHOUT,), ""),
                ((HEALTHY,), TESTED),
                ((MISREPORTING,), ""),
                ((MISREPORTING,), TESTED),
            ):
                cells = design.faulty(release, estimator, worlds, fusion)
                row.append(percent(results.loss(cells, healthy)))
            rows.append(row)
    header = [
        "", "healthy, error x 1000", "miscounts", "miscounts, test", "that detector left out",
        "healthy, test", "speeds misreported", "misreported, test",
    ]  # fmt: skip
    return markdown(header, rows)


def each_fault_table(results: PenetrationResults, release: str, estimator: str) -> str:
    """Return the error of each faulty detector, without a test, with it, and left out."""
    design = results.design
    rows = []
    for world, factor in FACTORS.items():
        for k, place in enumerate(design.detectors):
            cells = [
                design.faulty(release, estimator, (world,))[k],
                design.faulty(release, estimator, (world,), TESTED)[k],
                design.faulty(release, estimator, (WITHOUT,))[k],
            ]
            errors = (f"{results.mean(cell, ERROR).mean:.1f}" for cell in cells)
            rows.append([f"segment {place}, {factor:.2f} times", *errors])
    return markdown(["the detector that miscounts", "no test", "test", "left out"], rows)


def gain(interval: Interval) -> str:
    """Return a gain in per cent with its interval, in bold where it is one for certain."""
    return f"**{percent(interval)}**" if interval.low > 0.0 else percent(interval)


def percent(interval: Interval) -> str:
    """Return a share in per cent with its interval."""
    return f"{interval.mean:.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def share_label(share: float) -> str:
    """Return a share of connected vehicles for a table."""
    return f"{100.0 * share:g} %"


def _name(release: str, estimator: str) -> str:
    return f"`{release}`, {LABELS[estimator]}"


def _error(results: PenetrationResults, cell: PenetrationCell) -> str:
    error = results.mean(cell, ERROR)
    return f"{error.mean:.1f} ± {error.half_width:.1f}"


def _errors(results: PenetrationResults, cell: PenetrationCell) -> str:
    """Return both errors: density, then speed."""
    pair = (results.mean(cell, metric) for metric in (DENSITY, SPEED))
    return ", ".join(f"{each.mean:.1f} ± {each.half_width:.1f}" for each in pair)
