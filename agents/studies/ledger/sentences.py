"""Numbers behind the sentences of the report of the study of ledgers."""

from __future__ import annotations

from typing import Any

from agents.experiments.cells import DENSITY, METRICS, SPEED, Change
from agents.experiments.old_tables import format_interval
from agents.statistics import Interval
from agents.studies.ledger.cell import CAPPED, DEMAND, EXACT, PACED, PLAIN, REFERENCE
from agents.studies.ledger.expectations import judge_all
from agents.studies.ledger.results import EXHAUSTED, REFUSED, EqualError, LedgerResults

SETTINGS = ("pace", "clip", "ratio")
"""Settings of ``paced`` that the report has a sentence about."""
SLIGHT = 0.1
"""Differences of density errors below this [veh/km] are not named, however certain they are."""


def ladder_numbers(results: LedgerResults) -> dict[str, Any]:
    """Return the numbers of the report about the ladder."""
    design = results.design
    shipped, base, floor = design.shipped, design.cell(), design.cell(EXACT)
    filtered = design.cell(CAPPED, DEMAND, schedule=REFERENCE)
    best = base if design.single_only else design.sums()
    return {
        "shipped": [results.mean(shipped, metric) for metric in METRICS],
        "filter": results.change(filtered, shipped),
        "mechanism": results.change(design.cell(PACED, PLAIN, schedule=REFERENCE), shipped),
        "mechanism_too": results.change(design.cell(schedule=REFERENCE), filtered),
        "schedule": results.change(base, design.cell(schedule=REFERENCE)),
        "sums": None if design.single_only else results.change(design.sums(), base),
        "segments": results.change(design.cell(bandwidth=2 * design.bandwidth), base),
        "best": [results.mean(best, metric) for metric in METRICS],
        "best_percent": results.percent(best, shipped),
        "n_lower": results.n_lower(best, shipped),
        "floor": [results.mean(floor, metric) for metric in METRICS],
        "to_floor": results.change(base, floor),
    }


def equal_errors(results: LedgerResults) -> list[tuple[str, float, EqualError]]:
    """Return what is matched, by ``paced`` at which delta, and at which epsilon."""
    design = results.design
    at = f"ε = {design.epsilon:g}"
    same = [
        (f"`capped` (demand states, `{design.schedule}`, {at})", delta,
         results.equal_error(design.cell(CAPPED, delta=delta), delta))
        for delta in design.deltas
    ]  # fmt: skip
    shipped = results.equal_error(design.shipped, design.delta)
    return [*same, (f"`capped` as shipped (`{REFERENCE}`, {at})", design.delta, shipped)]


def variant_numbers(results: LedgerResults) -> list[tuple[str, str, Change]]:
    """Return what is protected in place of the base, and the change that it makes, paced first."""
    found = []
    for mechanism in (PACED, CAPPED):
        base, *others = results.design.variants(mechanism)
        for label, cell in others:
            found.append((mechanism, label, results.change(cell, base.cell)))
    return found


def best_setting(results: LedgerResults, name: str) -> dict[str, Any]:
    """Return the value of a setting with the least density error, and how far it is ahead."""
    design = results.design
    cells = design.along(name)
    best = min(cells, key=lambda cell: results.mean(cell, DENSITY).mean)
    fastest = min(cells, key=lambda cell: results.mean(cell, SPEED).mean)
    return {
        "values": [getattr(cell, name) for cell in cells],
        "base": getattr(design, name),
        "best": getattr(best, name),
        "change": results.difference(best, design.cell(), DENSITY),
        "best_speed": getattr(fastest, name),
        "speed_change": results.difference(fastest, design.cell(), SPEED),
    }


def policy_numbers(results: LedgerResults) -> dict[str, Any]:
    """Return the numbers of the report about schedules."""
    design = results.design
    cells = {name: design.policy_cells(name) for name in design.schedules}

    def ranked(place: int) -> list[tuple[str, Interval]]:
        means = [(name, results.mean(row[place], DENSITY)) for name, row in cells.items()]
        return sorted(means, key=lambda item: item[1].mean)

    followed = {
        name: results.difference(equal, paced, DENSITY) for name, (_, paced, equal) in cells.items()
    }
    certain = {
        name: gain
        for name, gain in followed.items()
        if gain.excludes_zero() and abs(gain.mean) >= SLIGHT
    }
    return {
        "capped": ranked(0),
        "paced": ranked(1),
        "need_following": [name for name, gain in certain.items() if gain.mean > 0.0],
        "need_equal": [name for name, gain in certain.items() if gain.mean < 0.0],
        "either": [name for name in followed if name not in certain],
        "slight": SLIGHT,
    }


def refusal_numbers(results: LedgerResults) -> dict[str, Any]:
    """Return the numbers of the report about vehicles that run out."""
    design = results.design
    base, capped = design.cell(), design.cell(CAPPED)
    places = results.refused_by_place(base)
    worst = max(range(len(places)), key=lambda place: places[place].mean)
    return {
        "base": [results.mean(base, field) for field in (EXHAUSTED, REFUSED)],
        "capped": [results.mean(capped, field) for field in (EXHAUSTED, REFUSED)],
        "median": results.spent_quantiles(base)[2],
        "capped_median": results.spent_quantiles(capped)[2],
        "place": worst,
        "at_place": places[worst],
        "sensors": [s for s in design.configs[0].corridor.fixed_sensors if s < len(places)],
    }


def shortfalls(results: LedgerResults) -> list[str]:
    """Return sentences about everything that fell short of what was expected or hoped for."""
    design, found = results.design, []
    for each in judge_all(results):
        if each.verdict != "met":
            text = f"{format_interval(each.measured)} {each.unit}"
            found.append(
                f"{each.statement}: {text}, expected at most {each.limit} ({each.verdict})."
            )
    names = results.schedules_without_gain()
    if names:
        listed = ", ".join(f"`{name}`" for name in names)
        found.append(
            f"Schedules under which `paced` does not certainly err less than `capped`: {listed}."
        )
    points = results.guarantees_without_gain()
    if points:
        listed = ", ".join(f"({epsilon:g}, {delta:g})" for epsilon, delta in points)
        found.append(f"Guarantees (ε, δ) at which it may err as much: {listed}.")
    variants = (design.variants(each)[1:] for each in (PACED, CAPPED))
    for (label, paced), (_, capped) in zip(*variants, strict=True):
        difference = results.difference(paced, capped, DENSITY)
        if difference.high >= 0.0:
            text = format_interval(difference)
            found.append(f"{label.capitalize()}: `paced` − `capped` is {text} veh/km.")
    for name in SETTINGS:
        best = best_setting(results, name)
        if best["change"].high < 0.0:
            text = f"{format_interval(best['change'])} veh/km"
            found.append(
                f"The base value of the {name}, {best['base']:g}, is not the best on this traffic: "
                f"{text} with {best['best']:g}."
            )
    return found
