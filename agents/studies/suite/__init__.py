"""The query suite: tasks with fixed traffic and noise, in which any query policy is compared.

Errors come first. A score is by how much a policy's error lies below that of the best rule that
ships, which validation traffic has chosen for each task. ``results/suite`` has the rows of the
rules, and the folders of entries.

dptse study suite
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from agents.environments import GUARANTEE, guarantee_of
from agents.figures import draw_errors, save_figure
from agents.play import Cell
from agents.statistics import Interval, interquartile_mean
from agents.studies.suite.entries import CARD, Entry, read_entry
from agents.studies.suite.scores import (
    Errors,
    Scores,
    choose_rules,
    errors_of,
    score,
    seeds_to_see,
    spread,
)
from agents.studies.suite.tasks import (
    ADVISED,
    MARKED,
    MARKS,
    NAME,
    PAPER_SCHEDULE,
    REPAIRED,
    ROUND_ROBIN,
    RULES,
    TASKS,
    VALIDATION,
    ekf_cell,
    make_cell,
    mark_cell,
    references,
    test_cells,
    validation_cells,
)
from agents.study import ROWS, Study, read_rows, read_table
from agents.tables import (
    UnmeasuredError,
    are_present,
    cell,
    format_range,
    give_or_take,
    grid,
    markdown,
    numbers,
)
from dptse_env.schedules import PROCESS_SCHEDULES
from dptse_env.utils.arrays import FloatArray
from dptse_env.versions import code_version

RECORDED = Path(__file__).parents[3] / "results" / "suite"
"""Folder of the rows that come with the package."""
ENTRIES, FIGURE = "entries", "scores.png"
"""Folder of entries in it, and its figure."""


def recorded() -> tuple[dict[str, str], pl.DataFrame]:
    """Return the rule of each task, and the rows that come with the package.

    Raises:
        ValueError: A rule was played with other numbers than those of this version.
    """
    rows = read_table(RECORDED / ROWS)
    rows = rows.filter(are_present(rows))
    rules = choose_rules(rows)
    for task in TASKS:
        try:
            errors_of(rows, *(make_cell(task, each) for each in references(rules[task])))
        except LookupError as problem:
            raise ValueError(
                f"{RECORDED / ROWS} lacks rules in the task {task!r} with the numbers of dptse-env "
                f"{code_version()}, so nothing can be scored; 'dptse study suite' in a checkout "
                "plays what is missing"
            ) from problem
    return rules, rows


class Line(NamedTuple):
    """A policy in the tables.

    Attributes:
        name: Its name, with a sign of what it reads.
        errors: Its errors.
        rule: Errors of the best rules on the same traffic.
        scores: Its scores; of nothing played they are empty.
        entry: What was entered, if it was.
    """

    name: str
    errors: Errors
    rule: Errors
    scores: Scores
    entry: Entry | None = None


SIGNS = {"observations": "", "process": " †", "truth": " ‡"}
"""Signs of what a policy reads."""


def read(path: Path, rules: Mapping[str, str], rows: pl.DataFrame) -> list[Line]:
    """Return the line of an entry, behind that of the paper's schedule on the same traffic.

    Args:
        path: Its card, beside which its rows are; on fresh traffic those of the rules, too.
        rules: The rule of each task.
        rows: The rows that come with the package, of equal numbers.

    Raises:
        FileNotFoundError, ValueError: See `read_entry`.
        UnmeasuredError: Rows with these numbers are missing.
    """
    entry, own = read_entry(path), read_rows("suite", path.parent)
    own = own.filter(numbers(own) == numbers(rows)[-1])
    known = rows if entry.fresh is None else own
    rules = {task: rules[task] for task in entry.policies}
    schedule = rule_line(
        PAPER_SCHEDULE, rules, known, lambda task, policy: entry.cells_of(task, policy)[0]
    )
    fresh = "" if entry.fresh is None else " on fresh traffic"
    errors = {task: errors_of(own, *entry.cells_of(task)) for task in rules}
    scores = score(errors, schedule.rule)
    name = f"{entry.name}{fresh}{SIGNS[entry.reads]}"
    return [schedule, Line(name, errors, schedule.rule, scores, entry)]


def rule_line(
    policy: str,
    rules: Mapping[str, str],
    rows: pl.DataFrame,
    cell_of: Callable[[str, str], Cell] = make_cell,
) -> Line:
    """Return the line of a schedule in the tasks of some rules, as far as it was played there."""
    errors, theirs = dict[str, FloatArray](), dict[str, FloatArray]()
    for task, rule in rules.items():
        with contextlib.suppress(UnmeasuredError):
            errors[task] = errors_of(rows, cell_of(task, policy))
            theirs[task] = errors_of(rows, cell_of(task, rule))
    errors = {task: errors[task] for task in theirs}
    reads = "truth" if policy in MARKS else "process" if policy in PROCESS_SCHEDULES else ""
    name = f"`{policy}`{SIGNS.get(reads, '')}"
    return Line(name, errors, theirs, score(errors, theirs))


def compare(lines: Sequence[Line], rules: Mapping[str, str]) -> tuple[list[str], list[list[str]]]:
    """Return header and lines of a table, by task: errors, and per cent below the best rule.

    Args:
        lines: Policies; the first is in all tasks that are shown.
        rules: The rule of each task.
    """

    def entry(line: Line, task: str) -> str:
        if task not in line.errors:
            return "-"
        return f"{_error(line.errors[task])}, {_percent(line.scores.tasks[task])}"

    shown = [["mean", "", "", *(_percent(line.scores.mean) for line in lines)]]
    for task in lines[0].errors:
        privacy = guarantee_of(TASKS[task].env, TASKS[task].keywords)
        best = f"{rules[task]} {_error(lines[0].rule[task])}"
        shown.append([task, privacy, best, *(entry(line, task) for line in lines)])
    return ["task", GUARANTEE, "best rule", *(line.name for line in lines)], shown


def _error(errors: FloatArray) -> str:
    return f"{float(interquartile_mean(errors)):.1f}"


def _percent(interval: Interval | None) -> str:
    return "-" if interval is None else give_or_take(interval)


# The report.


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables of rules, entries and marks; a dash stands for what was not played."""
    rows = rows.filter(numbers(rows) == numbers(rows)[-1])
    rules = choose_rules(rows)
    lines = [rule_line(each, rules, rows) for each in (PAPER_SCHEDULE, ROUND_ROBIN, *ADVISED)]
    for path in sorted((folder / ENTRIES).glob(f"*/{CARD}")):
        with contextlib.suppress(UnmeasuredError):  # one of other numbers, as rows are left out
            lines.append(read(path, rules, rows)[1])
    lines += [rule_line(each, rules, rows, mark_cell) for each in MARKS]
    lines.sort(key=lambda each: SIGNS["truth"] in each.name)  # which has no rank
    entered = [each for each in lines if each.entry]
    _draw(entered, folder / FIGURE)
    return "\n\n".join(
        [
            f"# {NAME}",
            "Errors x 1000, and per cent below the best rule, which validation traffic has chosen. "
            "Of entries it is the interquartile mean over their training seeds. † reads the state "
            "of the process, ‡ the truth; marks play some of the traffic. A dash: not played.",
            markdown(*compare(lines, rules)),
            "## Entries",
            markdown(ABOUT, [_about(each.entry, each) for each in entered if each.entry]),
            "## Rules on validation traffic, errors x 1000",
            grid("", RULES, list(TASKS), partial(_validated, rows)),
            "## With the EKF, errors x 1000",
            _ekf_table(rows, rules),
            "## Tasks",
            _task_table(rows, rules),
        ]
    )


ABOUT = [
    "entry", "below the best rule [%]", "track", "training seeds", "seconds of traffic",
    "processor minutes", "parameters", "reads", "tuning", "round robin in",
]  # fmt: skip


def _about(entry: Entry, line: Line) -> list[str]:
    counts = (entry.training_seeds, entry.steps, entry.minutes, entry.parameters)
    told = ("-" if each is None else f"{each:,}" for each in counts)
    left = ", ".join(entry.left) or "-"
    return [
        line.name, _percent(line.scores.mean), entry.track, *told, entry.reads, entry.tuning, left
    ]  # fmt: skip


def _validated(rows: pl.DataFrame, rule: str, task: str) -> str:
    return _error(errors_of(rows, make_cell(task, rule, part=VALIDATION)))


def _ekf_table(rows: pl.DataFrame, rules: Mapping[str, str]) -> str:
    """Return errors with the EKF, with and without repaired deviations."""
    repaired = f"`{ADVISED[1]}`, deviations repaired"
    network = "best rule, `recurrent`"

    def entry(name: str, task: str) -> str:
        if name == network:
            return _error(errors_of(rows, mark_cell(task, rules[task])))
        given = (ADVISED[1], REPAIRED) if name == repaired else (name,)
        return _error(errors_of(rows, ekf_cell(task, *given)))

    names = [PAPER_SCHEDULE, ROUND_ROBIN, *ADVISED, repaired, network]
    return grid("", names, [task for task in MARKED if task in rules], entry)


def _task_table(rows: pl.DataFrame, rules: Mapping[str, str]) -> str:
    def deviation(name: str) -> str:
        return f"{spread(rows, name, rules[name]):.1f}"

    def seeds(name: str) -> str:
        return str(seeds_to_see(spread(rows, name, rules[name])))

    heads = [
        "task", GUARANTEE, "validation seeds", "test seeds",
        "deviation of a paired difference [%]", "seeds that show 2 % nine times of ten",
    ]  # fmt: skip
    lines = [
        [
            f"`{name}`",
            guarantee_of(each.env, each.keywords),
            format_range(each.validation),
            format_range(each.seeds),
            *(cell(of, name) if name in rules else "-" for of in (deviation, seeds)),
        ]
        for name, each in TASKS.items()
    ]
    made = [f"{each.env} {json.dumps(each.keywords)}  # {name}" for name, each in TASKS.items()]
    return "\n\n".join([markdown(heads, lines), "\n".join(["```", *made, "```"])])


def _draw(lines: Sequence[Line], path: Path) -> None:
    """Save the scores of entries, by task."""
    label = "error below that of the best rule [%]"
    series = {
        each.name: {task: {label: found} for task, found in each.scores.tasks.items()}
        for each in lines
    }
    if series:
        figure = draw_errors(list(TASKS), series, log=False)
        save_figure(figure, path, f"{NAME}: entries and the best rule of each task, 95 % intervals")


STUDY = Study(
    "suite",
    tuple(validation_cells()),
    (),
    report,
    follow=lambda rows, place: test_cells(choose_rules(rows.filter(are_present(rows)))),
)
