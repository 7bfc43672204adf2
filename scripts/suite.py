"""Score policies in the tasks of the query suite.

dptse suite --policies round-robin --tasks short

Scores stand beside those of the policies that come with the package. What a folder has of an
earlier run is not played again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agents.play import Cell
from agents.policies import policy_name
from agents.studies.suite import (
    LEARNED,
    NAME,
    ONE,
    RULES,
    TASKS,
    ZERO,
    Scores,
    Task,
    beside_recorded,
    entry,
    format_scores,
    make_cell,
    score_all,
)
from agents.study import read_rows
from agents.study import run as run_study
from agents.terminal import make_table, print_table
from dptse_env.utils.fields import require, require_name
from scripts.cli import Machines


@dataclass(frozen=True)
class Args(Machines):
    """Score policies in the tasks of the query suite."""

    policies: tuple[str, ...] = ()
    """Schedules; saved policies by file or shipped name; "module:Class"."""
    tasks: tuple[str, ...] = ()
    """Tasks by name; all of them if none is given."""
    output: Path = Path("results/my-suite")
    """Folder of rows, tables and a figure."""


def main(args: Args) -> None:
    """Play the policies in the tasks that they suit, and report."""
    named = {policy_name(source): source for source in args.policies}
    require(bool(named), "policies", "one or more", args.policies)
    require(len(named) == len(args.policies), "policies", "of different names", args.policies)
    for name in args.tasks:
        require_name("tasks", name, [task.name for task in TASKS])
    tasks = [task for task in TASKS if not args.tasks or task.name in args.tasks]
    cells = [
        cell
        for name, source in named.items()
        for cell in suitable([make_cell(task, name, source) for task in tasks], source)
    ]
    study = entry(cells, tasks)
    run_study(study, args.place(args.output))
    rows = beside_recorded(read_rows(study.name, args.output), study.cells)
    print_scores(score_all(rows, tasks), list(named), tasks)
    print(f"tables and the figure are in {args.output}/")


def suitable(cells: Sequence[Cell], what: str) -> tuple[Cell, ...]:
    """Return the cells that can be played, and say how many do not suit what was given, and why.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: None can be played.
    """
    taken, refused = [], []
    for cell in cells:
        try:
            cell.check()
        except ValueError as problem:
            refused.append(problem)
        else:
            taken.append(cell)
    if not taken:
        raise refused[0]
    if refused:
        n = f"{len(refused)} of {len(cells)} cells"
        print(f"{n} do not suit {what} and are left out: {refused[0]}", file=sys.stderr)
    return tuple(taken)


def print_scores(scores: Scores, names: Sequence[str], tasks: Sequence[Task]) -> None:
    """Print the scores of policies by task, beside the best of those that come with the package."""
    others = [name for name in (*RULES, *LEARNED) if name not in (*names, ZERO, ONE)]

    def best(task: str) -> str:
        known = {name: scores[name][task] for name in others if task in scores.get(name, {})}
        if not known:
            return "-"
        name = max(known, key=lambda name: known[name].mean)
        return f"{name} {known[name].mean:.2f} ± {known[name].half_width:.2f}"

    titles = [task.name for task in tasks]
    table = make_table(f"{NAME}: scores", "task", *names, "best that comes with it")
    columns = [format_scores(scores[name], tasks) for name in names]
    for line in zip(["mean", *titles], *columns, ["", *map(best, titles)], strict=True):
        table.add_row(*line)
    print_table(table)
