"""Tables of the study of policies, in Markdown, and its summary as CSV."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
from agents.experiments import old_tables as tables
from agents.experiments.old_tables import format_interval, interval_columns, markdown
from agents.files import write_csv
from agents.statistics import iqm, mean
from agents.studies.policies.plan import REFERENCE, Learner
from agents.studies.policies.results import ERROR, METRICS, PolicyResults
from agents.studies.policies.rules import TargetVerdict
from dptse_env.utils.arrays import FloatArray


@dataclass(frozen=True)
class Rank:
    """A policy of a cell with its errors.

    Attributes:
        kind: ``baseline``, ``bound`` or ``learned``.
        n_runs: Training seeds behind it; 0 where nothing is trained.
        errors: By metric, errors on test traffic, shape (n_runs or 1, n_seeds).
    """

    label: str
    kind: str
    n_runs: int
    errors: dict[str, FloatArray]


def ranking(results: PolicyResults, cell: str) -> list[Rank]:
    """Return all policies that were run in a cell, least error first."""
    manifest = results.manifest

    def ranks() -> Iterator[Rank]:
        for kind, names in (("baseline", manifest.ladder), ("bound", manifest.bounds)):
            for name in names[cell]:
                errors = {metric: results.schedule(cell, name, metric) for metric in METRICS}
                yield Rank(name, kind, 0, errors)
        for learner in manifest.learners(results.design.cell(cell)):
            errors = {metric: results.learned(learner, metric) for metric in METRICS}
            yield Rank(learner.label, "learned", len(errors[ERROR]), errors)

    return sorted(ranks(), key=lambda rank: float(rank.errors[ERROR].mean()))


def ranking_table(results: PolicyResults, cell: str) -> str:
    """Return the ranking of a cell, with percentages below the best baseline."""
    baseline = results.choice(cell).baseline
    best, estimates = results.schedule(cell, baseline), list(METRICS)[1:]
    rows = []
    for rank in ranking(results, cell):
        below = format_interval(results.below(rank.errors[ERROR], best))
        if (rank.kind, rank.label) == ("baseline", baseline):
            below = "best on validation"
        rows.append(
            [
                f"**{rank.label}**" if rank.kind == "learned" else rank.label,
                f"learned, {rank.n_runs} training seed(s)" if rank.n_runs else rank.kind,
                format_interval(results.interval(mean, rank.errors[ERROR])),
                format_interval(results.interval(iqm, rank.errors[ERROR])),
                below,
                *(format_interval(results.interval(mean, rank.errors[m])) for m in estimates),
            ]
        )
    header = ["policy", "kind", "error × 1000", "IQM", "below best baseline [%]"]
    units = [METRICS[metric] for metric in estimates]
    return markdown([*header, *(f"{name} RMSE [{unit}]" for name, unit in units)], rows)


def verdict_table(verdicts: Sequence[TargetVerdict]) -> str:
    """Return one row for each target."""
    rows = [
        [
            f"at least {verdict.target.percent:g} % {verdict.target.description} "
            f"(`{verdict.reference}`)",
            "**met**" if verdict.is_met else "**missed**",
            format_interval(verdict.overall),
            f"{format_interval(verdict.worst)} (seed {verdict.worst_seed})",
            "; ".join(part for part, holds in verdict.parts.items() if not holds) or "-",
        ]
        for verdict in verdicts
    ]
    header = ["target", "verdict", "below [%]", "worst training seed [%]", "missing conditions"]
    return markdown(header, rows)


def seeds_table(results: PolicyResults, learner: Learner) -> str:
    """Return each training seed's error and percentages below both references."""
    references = [results.schedule(learner.cell, name) for name in results.references]
    rows = []
    seeds = results.manifest.runs(learner)
    for seed, errors in zip(seeds, results.learned(learner), strict=True):
        below = [format_interval(results.below(errors, reference)) for reference in references]
        rows.append([str(seed), format_interval(results.interval(mean, errors)), *below])
    header = ["training seed", "error × 1000"]
    return markdown([*header, *(f"below `{name}` [%]" for name in results.references)], rows)


def secondary_table(results: PolicyResults) -> str:
    """Return the comparisons of the secondary cells."""

    def probability(value: float) -> str:
        return "< 0.0001" if value < 1e-4 else f"{value:.4f}"

    rows = [
        [
            comparison.learner.cell,
            comparison.learner.label,
            str(len(results.manifest.runs(comparison.learner))),
            comparison.baseline,
            format_interval(comparison.below),
            format_interval(comparison.difference),
            probability(comparison.p_value),
            probability(comparison.adjusted),
            comparison.verdict,
        ]
        for comparison in results.comparisons
    ]
    header = [
        "cell", "policy", "training seeds", "best baseline", "below [%]", "difference × 1000", "p",
        "p (Holm)", "verdict",
    ]  # fmt: skip
    return markdown(header, rows)


def choice_table(results: PolicyResults) -> str:
    """Return the choices of validation traffic in each cell, and the best on test traffic."""
    rows = []
    for cell in results.design.cells:
        choice, best = results.choice(cell.name), results.best_on_test(cell.name)
        chosen, other = (results.schedule(cell.name, name) for name in (choice.baseline, best))
        gap = f"{best} ({format_interval(results.below(other, chosen))} % below)"
        learned = choice.learners.get(cell.name)
        rows.append(
            [
                f"{cell.name}: {cell.description}",
                choice.baseline,
                "the same" if best == choice.baseline else gap,
                ", ".join(learned) if learned else "-",
            ]
        )
    header = ["cell", "best baseline", "best on test traffic", "recipe and mode"]
    return markdown(header, rows)


def health_table(results: PolicyResults, cell: str) -> str:
    """Return the seconds that the estimator lost under policies of a cell; empty if none."""
    groups: dict[tuple[str, ...], list[EpisodeScore]] = {}
    for (entry, _), score in results.scores.items():
        if entry.cell == cell:
            groups.setdefault((f"{entry.policy}, {entry.mode}",), []).append(score)
    lost = {
        names: scores
        for names, scores in groups.items()
        if any(score.n_diverged or score.n_fallback or score.n_dropped for score in scores)
    }
    return tables.health_table(["policy"], lost) if lost else ""


def checkpoint_table(results: PolicyResults) -> str:
    """Return the policies that were frozen."""
    header = ["file", "cell", "recipe", "training seed", "sha256"]
    rows = [
        [f"`{each.path}`", each.cell, each.recipe, str(each.training_seed), each.sha256[:16]]
        for each in results.manifest.checkpoints
    ]
    return markdown(header, rows) if rows else ""


def tuned_table(results: PolicyResults) -> str:
    """Return the estimator settings that were tuned for single policies; empty if none."""
    header = ["settings of the estimator tuned for", "estimator", "ARZ", "preset"]
    tuned = results.manifest.tuned
    rows = [[each.policy, each.estimator, each.parameters, each.privacy] for each in tuned]
    return markdown(header, rows) if rows else ""


def write_summary(path: Path, results: PolicyResults) -> None:
    """Write the rankings of all cells as CSV, one row for each policy."""
    columns = ["cell", "policy", "kind", "n_training_seeds", "n_traffic_seeds"]
    for name in (*METRICS, "iqm", "percent_below_best", "percent_below_paper"):
        columns += [name, f"{name}_low", f"{name}_high"]

    def rows() -> Iterator[list[Any]]:
        for cell in results.design.cells:
            names = results.choice(cell.name).baseline, REFERENCE
            references = [results.schedule(cell.name, name) for name in names]
            for rank in ranking(results, cell.name):
                errors = rank.errors[ERROR]
                intervals = [results.interval(mean, table) for table in rank.errors.values()]
                intervals.append(results.interval(iqm, errors))
                intervals += [results.below(errors, reference) for reference in references]
                row = [cell.name, rank.label, rank.kind, rank.n_runs, errors.shape[1]]
                yield [*row, *(text for each in intervals for text in interval_columns(each))]

    write_csv(path, columns, rows())
