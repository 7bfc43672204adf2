"""Tables of the report, in Markdown, and the summary as CSV."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.statistics import Interval, geometric_mean_interval, mean_interval
from agents.studies.paper.claims import Claim, Outcome, judge
from agents.studies.paper.measures import DENSITY, LABELS, SPEED, percent
from agents.studies.paper.plan import ESTIMATORS, SETTINGS, Cell
from agents.studies.paper.results import Measured
from agents.studies.paper.timing import PAPER_SECONDS


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is left-aligned, the others centred."""
    lines = [header, ["---", *[":-:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def outcomes(claims: Iterable[Claim], measured: Measured) -> dict[str, list[Outcome]]:
    """Judge claims under every setting; by the claim's key."""
    return {claim.key: [judge(claim, measured, own) for own in SETTINGS] for claim in claims}


def shown(interval: Interval) -> str:
    """Return a mean with its interval."""
    return f"{_number(interval.mean)} [{_number(interval.low)}, {_number(interval.high)}]"


def _number(value: float) -> str:
    """Three significant digits or two decimals, whichever says more."""
    if 0.0 < abs(value) < 0.1:
        return f"{value:.2g}"
    return f"{value:.1f}" if abs(value) >= 100 else f"{value:.2f}"


_MARKS = {
    "holds": "**holds**",
    "does not hold": "does **not** hold",
    "undecided": "undecided",
    "not measured": "not measured",
}
_HEADER = [str(setting) for setting in SETTINGS]


def verdict_table(judged: dict[str, list[Outcome]]) -> str:
    """Return one row for each claim, with the count of its parts that hold."""

    def cell(outcome: Outcome) -> str:
        n_held = sum(verdict == "holds" for _, verdict in outcome.parts.values())
        count = f" ({n_held} of {len(outcome.parts)})" if outcome.parts else ""
        return _MARKS[outcome.verdict] + count

    rows = [[f"{key}. {own[0].claim.says}", *map(cell, own)] for key, own in judged.items()]
    return markdown(["claim", *_HEADER], rows)


def detail(own: Sequence[Outcome]) -> str:
    """Return what was measured for one claim: a row for each part."""
    claim = own[0].claim
    signs = {"holds": "✓", "does not hold": "✗", "undecided": "?"}
    names = list(dict.fromkeys(name for outcome in own for name in outcome.parts))

    def cell(outcome: Outcome, name: str) -> str:
        interval, verdict = outcome.parts[name]
        return f"{shown(interval)} {signs[verdict]}"

    rows = [[name, *(cell(outcome, name) for outcome in own)] for name in names]
    rows.append(["**verdict**", *(_MARKS[outcome.verdict] for outcome in own)])
    return (
        f"**{claim.key}. {claim.says}**\n\n"
        f"Measured: {claim.measured} [{claim.unit}]. Holds if {claim.expected}.\n\n"
        + markdown(["part", *_HEADER], rows)
    )


def base_table(measured: Measured, metric: str) -> str:
    """Return errors at the base point, and by how much they exceed the random walk's [%]."""
    rows = []
    for name in measured.design.all_estimators:
        row = [LABELS[name]]
        for setting in SETTINGS:
            own = measured.base(name, setting, metric)
            walk = measured.base("random_walk", setting, metric)
            text = shown(mean_interval(own))
            if name != "random_walk":
                excess = percent(own, walk)
                text += f"; {excess.mean:+.1f} ± {excess.half_width:.1f} %"
            row.append(text)
        rows.append(row)
    return markdown(["estimator", *_HEADER], rows)


def time_table(measured: Measured) -> str:
    """Return times of a step beside the paper's [ms], and relative to the EKF's."""
    rows = []
    for name in measured.design.all_estimators:
        told = name in ESTIMATORS
        row = [
            LABELS[name],
            f"{PAPER_SECONDS[name] * 1e3:g}" if told else "-",
            f"{PAPER_SECONDS[name] / PAPER_SECONDS['ekf']:.2f}" if told else "-",
        ]
        for setting in SETTINGS:
            own = measured.seconds(name, setting)
            text = shown(geometric_mean_interval(own * 1e3))
            if "ekf" in measured.design.estimators:
                ratio = geometric_mean_interval(own / measured.seconds("ekf", setting))
                text += f"; {ratio.mean:.2f}"
            row.append(text)
        rows.append(row)
    return markdown(["estimator", "paper [ms]", "paper, / EKF", *_HEADER], rows)


def health_table(measured: Measured) -> str:
    """Return seconds lost by each estimator under each setting, over all its episodes."""
    rows = []
    for name in measured.design.all_estimators:
        row = [LABELS[name]]
        for setting in SETTINGS:
            stands_for = [
                cell
                for field in measured.design.sweeps
                for cell in measured.design.along(field, name, setting)
            ]
            cells = list(dict.fromkeys([*stands_for, measured.design.base(name, setting)]))
            diverged, fallback = (
                sum(float(measured.values(cell, metric).sum()) for cell in cells)
                for metric in ("n_diverged", "n_fallback")
            )
            n_episodes = len(cells) * len(measured.design.seeds)
            row.append(f"{diverged:.0f}, {fallback:.0f} (of {n_episodes} episodes)")
        rows.append(row)
    return markdown(["estimator", *_HEADER], rows)


def write_summary(path: Path, measured: Measured) -> None:
    """Write means with intervals as CSV, one row for each cell."""
    metrics = {DENSITY: "veh_km", SPEED: "km_h"}
    columns = [field.name for field in dataclasses.fields(Cell)]
    columns += ["n_seeds"]
    for metric, unit in metrics.items():
        columns += [f"{metric}_{unit}", f"{metric}_low", f"{metric}_high"]
    columns += ["reward", "reward_low", "reward_high", "n_diverged", "n_fallback"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for cell in sorted(measured.design.cells(), key=dataclasses.astuple):
            row: list[Any] = [*dataclasses.astuple(cell), len(measured.design.seeds)]
            for metric in (*metrics, "reward"):
                own = mean_interval(measured.values(cell, metric))
                row += [f"{value:.6g}" for value in (own.mean, own.low, own.high)]
            row += [measured.values(cell, f"n_{kind}").sum() for kind in ("diverged", "fallback")]
            writer.writerow(row)
