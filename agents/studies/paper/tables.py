"""Tables of the reproduction, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from agents.evaluation.episodes import EpisodeScore
from agents.experiments import old_tables as tables
from agents.experiments.old_tables import format_interval, markdown
from agents.figures import LABELS
from agents.statistics import geometric_mean_interval, mean_interval
from agents.studies.paper.claims import Outcome
from agents.studies.paper.measures import percent
from agents.studies.paper.plan import PAPER_ESTIMATORS, SETTINGS
from agents.studies.paper.results import PaperResults
from agents.studies.paper.timing import PAPER_SECONDS

_MARKS = {
    "holds": "**holds**",
    "does not hold": "does **not** hold",
    "undecided": "undecided",
    "not measured": "not measured",
}
_SIGNS = {"holds": "✓", "does not hold": "✗", "undecided": "?"}
_HEADER = [str(setting) for setting in SETTINGS]


def verdict_table(judged: Iterable[Sequence[Outcome]]) -> str:
    """Return one row for each claim, with the count of its parts that hold."""

    def cell(outcome: Outcome) -> str:
        n_held = sum(verdict == "holds" for _, verdict in outcome.parts.values())
        count = f" ({n_held} of {len(outcome.parts)})" if outcome.parts else ""
        return _MARKS[outcome.verdict] + count

    claims = [(outcomes[0].claim, outcomes) for outcomes in judged]
    rows = [[f"{claim.key}. {claim.statement}", *map(cell, row)] for claim, row in claims]
    return markdown(["claim", *_HEADER], rows)


def parts_table(outcomes: Sequence[Outcome]) -> str:
    """Return the measurements for one claim: a row for each part, the verdict last."""
    names = dict.fromkeys(name for outcome in outcomes for name in outcome.parts)
    rows = []
    for name in names:
        parts = [outcome.parts[name] for outcome in outcomes]
        rows.append([name, *(f"{format_interval(i)} {_SIGNS[verdict]}" for i, verdict in parts)])
    rows.append(["**verdict**", *(_MARKS[outcome.verdict] for outcome in outcomes)])
    return markdown(["part", *_HEADER], rows)


def base_table(results: PaperResults, metric: str) -> str:
    """Return errors at the base point, and by how much they exceed the random walk's [%]."""
    rows = []
    for name in results.design.all_estimators:
        row = [LABELS[name]]
        for setting in SETTINGS:
            errors = results.base(name, setting, metric)
            text = format_interval(mean_interval(errors))
            if name != "random_walk":
                excess = percent(errors, results.base("random_walk", setting, metric))
                text += f"; {excess.mean:+.1f} ± {excess.half_width:.1f} %"
            row.append(text)
        rows.append(row)
    return markdown(["estimator", *_HEADER], rows)


def time_table(results: PaperResults) -> str:
    """Return times of a step beside the paper's [ms], and relative to the EKF's."""
    rows = []
    for name in results.design.all_estimators:
        row = [LABELS[name], "-", "-"]
        if name in PAPER_ESTIMATORS:
            seconds = PAPER_SECONDS[name]
            row[1:] = [f"{seconds * 1e3:g}", f"{seconds / PAPER_SECONDS['ekf']:.2f}"]
        for setting in SETTINGS:
            times = results.seconds(name, setting)
            text = format_interval(geometric_mean_interval(times * 1e3))
            if "ekf" in results.design.estimators:
                ratio = geometric_mean_interval(times / results.seconds("ekf", setting))
                text += f"; {ratio.mean:.2f}"
            row.append(text)
        rows.append(row)
    return markdown(["estimator", "paper [ms]", "paper, / EKF", *_HEADER], rows)


def health_table(results: PaperResults) -> str:
    """Return the seconds that each estimator lost under each setting, over all its episodes."""
    groups: dict[tuple[str, ...], list[EpisodeScore]] = {
        (LABELS[name], str(setting)): results.episodes(*results.design.cells_of(name, setting))
        for name in results.design.all_estimators
        for setting in SETTINGS
    }
    return tables.health_table(["estimator", "setting"], groups)


def grid_table(results: PaperResults) -> str:
    """Return the values of the sweeps."""
    names = {"bandwidth": "number of CV segments", "epsilon": "ε", "delta": "δ"}
    sweeps = results.design.sweeps
    rows = [[name, ", ".join(f"{x:g}" for x in sweeps[field])] for field, name in names.items()]
    return markdown(["grid", "values"], rows)
