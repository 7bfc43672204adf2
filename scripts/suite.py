"""Score policies in the tasks of the query suite, beside those that come with the package.

python scripts/suite.py --policies round-robin my_package:MySchedule
python scripts/suite.py --policies results/training/best.safetensors --output results/my-suite
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
    beside_recorded,
    entry,
    format_scores,
    make_cell,
    score_all,
)
from agents.study import read_rows
from agents.study import run as run_study
from agents.terminal import make_table, print_table
from dptse_env.utils.fields import require
from scripts.cli import Machines


@dataclass(frozen=True)
class Args(Machines):
    """Score policies in the tasks of the query suite."""

    policies: tuple[str, ...] = ()
    """Schedules and policies: names, files of saved ones, "module:Class", and models of
    stable-baselines3 as "module:Class=file.zip", which are unpickled: load those that you trust."""
    output: Path = Path("results/my-suite")
    """Folder of rows, tables and a figure."""


def main(args: Args) -> None:
    """Play the policies in the tasks that they suit, and report."""
    named = {policy_name(source): source for source in args.policies}
    require(bool(named), "policies", "one or more", args.policies)
    require(len(named) == len(args.policies), "policies", "of different names", args.policies)
    cells = [
        cell
        for name, source in named.items()
        for cell in suitable([make_cell(task, name, source) for task in TASKS], source)
    ]
    study = entry(cells, TASKS)
    run_study(study, args.place(args.output))
    rows = beside_recorded(read_rows(study.name, args.output), study.cells)
    print_scores(score_all(rows, TASKS), list(named))
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


def print_scores(scores: Scores, names: Sequence[str]) -> None:
    """Print the scores of policies by task, beside the best of those that come with the package."""
    others = [name for name in (*RULES, *LEARNED) if name not in (*names, ZERO, ONE)]

    def best(task: str) -> str:
        known = {name: scores[name][task] for name in others if task in scores.get(name, {})}
        if not known:
            return "-"
        name = max(known, key=lambda name: known[name].mean)
        return f"{name} {known[name].mean:.2f} ± {known[name].half_width:.2f}"

    tasks = [task.name for task in TASKS]
    table = make_table(f"{NAME}: scores", "task", *names, "best that comes with it")
    columns = [format_scores(scores[name], TASKS) for name in names]
    for line in zip(["mean", *tasks], *columns, ["", *map(best, tasks)], strict=True):
        table.add_row(*line)
    print_table(table)
