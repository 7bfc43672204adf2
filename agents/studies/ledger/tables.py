"""Tables of the study of ledgers, in Markdown."""

from __future__ import annotations

import itertools

from agents.evaluation.contributions import LENGTHS, QUANTILES
from agents.evaluation.episodes import EpisodeScore
from agents.experiments import old_tables as tables
from agents.experiments.cells import DENSITY, METRICS
from agents.experiments.old_tables import (
    compared_errors,
    compared_header,
    format_interval,
    markdown,
)
from agents.statistics import Interval
from agents.studies.ledger.cell import CAPPED, FILTER_LABELS, FILTERS, MECHANISMS, PACED, LedgerCell
from agents.studies.ledger.expectations import judge_all
from agents.studies.ledger.plan import Named
from agents.studies.ledger.results import EXHAUSTED, REFUSED, LedgerResults

REFUSED_HEADER = "refused [%]"


def ladder_table(results: LedgerResults) -> str:
    """Return both errors of every rung, and their paired differences to the rung it rests on."""
    ladder = results.design.ladder()
    numbers: dict[LedgerCell, int] = {}
    rows = []
    for k, (label, cell, base) in enumerate(ladder, start=1):
        numbers.setdefault(cell, k)
        rest = "-" if base is None else str(numbers[base])
        errors = compared_errors(results, cell, base)
        rows.append([f"{k}. {label}", rest, *errors, _percent(results, cell, REFUSED)])
    header = ["rung", "base", *compared_header("base"), REFUSED_HEADER]
    return markdown(header, rows)


def guarantees_table(results: LedgerResults) -> str:
    """Return the density error of every rung at every guarantee."""
    design = results.design
    ladders = [design.ladder(*guarantee) for guarantee in design.guarantees]
    rows = []
    for k, rungs in enumerate(zip(*ladders, strict=True), start=1):
        means = [format_interval(results.mean(rung.cell, DENSITY)) for rung in rungs]
        rows.append([f"{k}. {rungs[0].label}", *means])
    header = [f"(ε, δ) = ({epsilon:g}, {delta:g})" for epsilon, delta in design.guarantees]
    return markdown(["rung", *header], rows)


def epsilon_table(results: LedgerResults, metric: str) -> str:
    """Return errors by mechanism and delta (rows) and epsilon (columns), and their differences."""
    design, rows = results.design, []
    for delta in design.deltas:
        capped, paced = (design.along_epsilon(each, delta) for each in (CAPPED, PACED))
        for name, cells in ((CAPPED, capped), (PACED, paced)):
            means = [format_interval(each) for each in results.means(cells, metric)]
            rows.append([f"`{name}`, δ = {delta:g}", *means])
        pairs = zip(paced, capped, strict=True)
        differences = [format_interval(results.difference(*pair, metric)) for pair in pairs]
        rows.append([f"difference, δ = {delta:g}", *differences])
    return markdown(["mechanism", *(f"ε = {value:g}" for value in design.epsilons)], rows)


def filter_table(results: LedgerResults) -> str:
    """Return both errors of every filter under ``paced``, and the difference to the first."""
    rows = []
    for queries, filters in results.design.filter_tables.items():
        for label, cell in filters:
            errors = compared_errors(results, cell, filters[0].cell)
            rows.append([queries, label, *errors, _percent(results, cell, REFUSED)])
    header = ["queries a second", "filter", *compared_header("the first"), REFUSED_HEADER]
    return markdown(header, rows)


def variants_table(results: LedgerResults) -> str:
    """Return errors by what is protected, and the paired difference to the base."""
    rows = []
    for mechanism in (CAPPED, PACED):
        variants = results.design.variants(mechanism)
        for label, cell in variants:
            errors = compared_errors(results, cell, variants[0].cell)
            rows.append([f"`{mechanism}`", label, *errors, _percent(results, cell, REFUSED)])
    header = ["mechanism", "protected", *compared_header("the first"), REFUSED_HEADER]
    return markdown(header, rows)


def settings_table(results: LedgerResults) -> str:
    """Return errors by pace, clip and ratio, and the paired difference to the base values."""
    design = results.design
    groups = [("pace", delta) for delta in design.deltas]
    groups += [(name, design.delta) for name in ("clip", "ratio")]
    rows = []
    for name, delta in groups:
        base = design.cell(delta=delta)
        for cell in design.along(name, delta=delta):
            rows.append(
                [
                    f"{name} {getattr(cell, name):g}",
                    f"{delta:g}",
                    *compared_errors(results, cell, base),
                    _percent(results, cell, REFUSED),
                    _percent(results, cell, EXHAUSTED),
                ]
            )
    header = ["setting", "δ", *compared_header("base"), REFUSED_HEADER, "spent [%]"]
    return markdown(header, rows)


def policy_table(results: LedgerResults) -> str:
    """Return density errors and refusals of every schedule under both mechanisms and pacings."""
    design, rows = results.design, []
    for name in design.schedules:
        capped, paced, equal = design.policy_cells(name)
        cells = (capped, paced, equal)
        gains = [results.difference(*pair, DENSITY) for pair in ((paced, capped), (equal, paced))]
        rows.append(
            [
                f"`{name}`",
                *(format_interval(results.mean(cell, DENSITY)) for cell in cells),
                *map(format_interval, gains),
                *(f"{results.mean(cell, REFUSED).mean:.2f}" for cell in cells),
            ]
        )
    header = [
        "schedule", "`capped`", "`paced`", "`paced`, equal rates", "`paced` − `capped`",
        "equal − followed rates", "refused by `capped` [%]", "by `paced` [%]",
        "by `paced`, equal rates [%]",
    ]  # fmt: skip
    return markdown(header, rows)


def policy_speed_table(results: LedgerResults) -> str:
    """Return the speed errors of every schedule under both mechanisms and pacings."""
    speed = list(METRICS)[1]
    rows = [
        [f"`{name}`", *map(format_interval, results.means(design_cells, speed))]
        for name in results.design.schedules
        for design_cells in [results.design.policy_cells(name)]
    ]
    return markdown(["schedule", "`capped`", "`paced`", "`paced`, equal rates"], rows)


def ledger_table(results: LedgerResults) -> str:
    """Return what vehicles have spent at the end of their trips, and what was refused."""
    rows = []
    for label, cell in results.design.watched:
        quantiles = [f"{each.mean:.2f}" for each in results.spent_quantiles(cell)]
        places = results.refused_by_place(cell)
        worst = max(range(len(places)), key=lambda place: places[place].mean)
        rows.append(
            [
                label,
                _percent(results, cell, EXHAUSTED),
                " / ".join(quantiles),
                _percent(results, cell, REFUSED),
                f"{worst}: {format_interval(places[worst])}",
            ]
        )
    levels = " / ".join(f"{100 * level:g} %" for level in QUANTILES)
    header = ["", "spent above 95 % [%]", f"spent at the quantiles {levels}", REFUSED_HEADER]
    return markdown([*header, "most refused: segment and share [%]"], rows)


def place_table(results: LedgerResults, cells: list[Named]) -> str:
    """Return the mean share of contributions refused on each mainline segment [%]."""
    shares = {label: results.refused_by_place(cell) for label, cell in cells}
    rows = [[label, *(f"{each.mean:.2f}" for each in places)] for label, places in shares.items()]
    n = len(rows[0]) - 1
    return markdown(["segment", *map(str, range(n))], rows)


def length_table(results: LedgerResults, cells: list[Named]) -> str:
    """Return spent budgets and refused contributions [%] by length of trip."""
    rows = []
    for label, cell in cells:
        for name, shares in (
            ("spent", results.spent_by_length(cell)),
            ("refused", results.refused_by_length(cell)),
        ):
            rows.append([label, name, *map(_or_dash, shares)])
    return markdown(["", "[%]", *LENGTH_LABELS], rows)


LENGTH_LABELS = [
    *(f"{first} to {end} s" for first, end in itertools.pairwise(LENGTHS)),
    f"{LENGTHS[-1]} s or more",
]
"""Names of the bins of trips by their length."""


def expectation_table(results: LedgerResults) -> str:
    """Return what was expected, what was measured, and the verdicts."""
    rows = [
        [
            each.statement,
            each.limit,
            f"{format_interval(each.measured)} {each.unit}",
            f"**{each.verdict}**",
        ]
        for each in judge_all(results)
    ]
    return markdown(["density error, or share", "expected at most", "measured", "verdict"], rows)


def health_table(results: LedgerResults) -> str:
    """Return the seconds that each filter lost under each mechanism, over all its episodes."""
    cells = results.design.cells()
    groups: dict[tuple[str, ...], list[EpisodeScore]] = {}
    for mechanism in MECHANISMS:
        for name in FILTERS:
            own = [c for c in cells if (c.mechanism, c.filter_name) == (mechanism, name)]
            if own:
                groups[f"`{mechanism}`", FILTER_LABELS[name]] = results.episodes(*own)
    return tables.health_table(["mechanism", "filter"], groups)


def _percent(results: LedgerResults, cell: LedgerCell, field: str) -> str:
    return format_interval(results.mean(cell, field))


def _or_dash(interval: Interval | None) -> str:
    return "-" if interval is None else format_interval(interval)
