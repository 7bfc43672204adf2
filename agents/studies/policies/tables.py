"""Tables of the study, in Markdown, and the summary as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from agents.evaluation.statistics import FloatArray, Interval, iqm, mean
from agents.studies.paper.tables import markdown, shown
from agents.studies.policies.plan import REFERENCE, Learner
from agents.studies.policies.results import ERROR, METRICS, Measured
from agents.studies.policies.rules import Verdict


@dataclass(frozen=True)
class Rung:
    """One policy of a cell.

    Attributes:
        label: Its name.
        kind: ``baseline``, ``bound`` or ``learned``.
        n_runs: Training seeds behind it; 0 where nothing is trained.
        errors: By metric, errors on test traffic, shape (n_runs or 1, n_seeds).
    """

    label: str
    kind: str
    n_runs: int
    errors: dict[str, FloatArray]


def ladder(measured: Measured, cell: str) -> list[Rung]:
    """Return everyone who was run in a cell, least error first."""
    manifest = measured.manifest

    def rungs() -> Iterator[Rung]:
        for kind, names in (("baseline", manifest.ladder), ("bound", manifest.bounds)):
            for name in names[cell]:
                errors = {metric: measured.schedule(cell, name, metric) for metric in METRICS}
                yield Rung(name, kind, 0, errors)
        for learner in manifest.learners(measured.design.cell(cell)):
            errors = {metric: measured.learned(learner, metric) for metric in METRICS}
            yield Rung(learner.label, "learned", len(errors[ERROR]), errors)

    return sorted(rungs(), key=lambda rung: float(rung.errors[ERROR].mean()))


def ladder_table(measured: Measured, cell: str) -> str:
    """Return the ladder of a cell, with everyone's percentage below the best baseline."""
    best = measured.schedule(cell, measured.choice(cell).baseline)
    rows = []
    for rung in ladder(measured, cell):
        table = rung.errors[ERROR]
        below = shown(measured.below(table, best))
        if rung.kind == "baseline" and rung.label == measured.choice(cell).baseline:
            below = "best on validation"
        rows.append(
            [
                f"**{rung.label}**" if rung.kind == "learned" else rung.label,
                f"learned, {rung.n_runs} training seed(s)" if rung.n_runs else rung.kind,
                shown(measured.interval(mean, table)),
                shown(measured.interval(iqm, table)),
                below,
                *(
                    shown(measured.interval(mean, rung.errors[metric]))
                    for metric in list(METRICS)[1:]
                ),
            ]
        )
    header = [
        "policy",
        "kind",
        "error × 1000",
        "IQM",
        "below best baseline [%]",
        *(f"{name} RMSE [{unit}]" for name, unit in list(METRICS.values())[1:]),
    ]
    return markdown(header, rows)


def verdict_table(verdicts: list[Verdict]) -> str:
    """Return one row for each target."""
    rows = [
        [
            f"at least {own.target.percent:g} % {own.target.says} (`{own.reference}`)",
            "**met**" if own.is_met else "**missed**",
            shown(own.overall),
            f"{shown(own.worst)} (seed {own.worst_seed})",
            "; ".join(says for says, is_so in own.parts.items() if not is_so) or "-",
        ]
        for own in verdicts
    ]
    header = ["target", "verdict", "below [%]", "worst training seed [%]", "what is wanting"]
    return markdown(header, rows)


def seeds_table(measured: Measured, learner: Learner) -> str:
    """Return each training seed's error and percentages below both references."""
    errors = measured.learned(learner)
    references = [measured.schedule(learner.cell, name) for name in measured.references]
    rows = [
        [
            str(seed),
            shown(measured.interval(mean, own)),
            *(shown(measured.below(own, reference)) for reference in references),
        ]
        for seed, own in zip(measured.manifest.runs(learner), errors, strict=True)
    ]
    header = ["training seed", "error × 1000"]
    return markdown([*header, *(f"below `{name}` [%]" for name in measured.references)], rows)


def secondary_table(measured: Measured) -> str:
    """Return the comparisons of the secondary cells."""
    rows = [
        [
            own.learner.cell,
            own.learner.label,
            str(len(measured.manifest.runs(own.learner))),
            own.baseline,
            shown(own.below),
            shown(own.difference),
            _probability(own.p_value),
            _probability(own.adjusted),
            own.verdict,
        ]
        for own in measured.comparisons
    ]
    header = [
        "cell", "policy", "training seeds", "best baseline", "below [%]", "difference × 1000", "p",
        "p (Holm)", "verdict",
    ]  # fmt: skip
    return markdown(header, rows)


def _probability(value: float) -> str:
    return "< 0.0001" if value < 1e-4 else f"{value:.4f}"


def choice_table(measured: Measured) -> str:
    """Return what validation traffic chose in each cell, and what was best on test traffic."""
    rows = []
    for cell in measured.design.cells:
        choice = measured.choice(cell.name)
        learned = choice.learners.get(cell.name)
        best = measured.best_on_test(cell.name)
        gap = measured.below(
            measured.schedule(cell.name, best), measured.schedule(cell.name, choice.baseline)
        )
        rows.append(
            [
                f"{cell.name}: {cell.says}",
                choice.baseline,
                "the same" if best == choice.baseline else f"{best} ({shown(gap)} % below)",
                ", ".join(learned) if learned else "-",
            ]
        )
    header = ["cell", "best baseline", "best on test traffic", "recipe and mode"]
    return markdown(header, rows)


def health_table(measured: Measured, cell: str) -> str:
    """Return seconds lost by the estimator under each policy of a cell, over all episodes."""
    totals: dict[str, list[float]] = {}
    for (entry, _), score in measured.scores.items():
        if entry.cell == cell:
            own = totals.setdefault(f"{entry.policy}, {entry.mode}", [0.0, 0.0, 0.0])
            for k, name in enumerate(("n_diverged", "n_fallback", "n_dropped")):
                own[k] += getattr(score, name)
    rows = [[name, *(f"{value:.0f}" for value in own)] for name, own in totals.items() if any(own)]
    if not rows:
        return "None, under any policy."
    return markdown(["policy", "started over [s]", "kept the prediction [s]", "dropped"], rows)


def write_summary(path: Path, measured: Measured) -> None:
    """Write the ladders of all cells as CSV, one row for each policy."""
    columns = ["cell", "policy", "kind", "n_training_seeds", "n_traffic_seeds"]
    for metric in METRICS:
        columns += [metric, f"{metric}_low", f"{metric}_high"]
    columns += ["iqm", "iqm_low", "iqm_high"]
    for against in ("best", "paper"):
        columns += [f"percent_below_{against}{end}" for end in ("", "_low", "_high")]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for cell in measured.design.cells:
            name = cell.name
            references = [
                measured.schedule(name, own) for own in (measured.choice(name).baseline, REFERENCE)
            ]
            for rung in ladder(measured, name):
                errors = rung.errors[ERROR]
                intervals = [measured.interval(mean, table) for table in rung.errors.values()]
                intervals.append(measured.interval(iqm, errors))
                intervals += [measured.below(errors, own) for own in references]
                row = [name, rung.label, rung.kind, rung.n_runs, errors.shape[1]]
                writer.writerow([*row, *(text for own in intervals for text in _ends(own))])


def _ends(interval: Interval) -> list[str]:
    return [f"{value:.6g}" for value in (interval.mean, interval.low, interval.high)]
