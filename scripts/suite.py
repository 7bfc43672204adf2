"""Score a query policy in the cells of the query suite, and write its card.

dptse suite mine.safetensors

Scores stand beside the best rule's. What a folder has of an earlier run is not played again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl
import tyro

import dptse_env
from agents.files import write_json
from agents.play import Cell
from agents.policies import policy_name
from agents.studies import suite
from agents.study import Study, play_study
from agents.terminal import make_table, print_table
from scripts.cli import Machines

CARD = "card.json"


@dataclass(frozen=True, kw_only=True)
class Args(Machines):
    """Score a query policy in the cells of the query suite, and write its card."""

    policy: tyro.conf.Positional[str]
    """A schedule; a saved policy by file or shipped name, or "module:Class"."""
    beside: tuple[Path, ...] = ()
    """Cards of other policies, to be shown beside it."""
    output: Path | None = None
    """Folder of the card and the rows; results/my-suite/POLICY if not given."""


def main(args: Args) -> None:
    """Play the policy in the cells that it suits, write its card, and print scores."""
    name = policy_name(args.policy)
    others = [suite.read_card(path) for path in args.beside]
    recorded = suite.recorded_rows()
    cells = suitable(
        [suite.make_cell(each, name, args.policy) for each in suite.CELLS], args.policy
    )
    # A schedule by "module:Class" has a character that not every system allows in a path.
    folder = args.output or Path("results/my-suite") / name.replace(":", "-")
    study = Study("suite", cells, suite.SEEDS, lambda rows, folder: "")
    played = play_study(study, args.place(folder))
    # The folder may have rows of other policies, and of an earlier state of this one's file.
    own = played.filter(
        pl.col("cell").is_in([each.id for each in cells]), version=dptse_env.__version__
    )
    rows: pl.DataFrame = pl.concat([recorded, *others, own], how="diagonal_relaxed")
    rows = rows.unique(("version", "policy", "name", "traffic_seed"), keep="last")
    write_json(folder / CARD, suite.make_card(rows, name, args.policy))
    print_scores(rows, [name, *(each["policy"][0] for each in others)])
    print(f"the card is {folder / CARD}")


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


def print_scores(rows: pl.DataFrame, policies: Sequence[str]) -> None:
    """Print scores by cell, those of the best rule beside them, and what the oracle gains."""
    scores = suite.score_all(rows)
    columns = {policy: suite.format_scores(each) for policy, each in scores.items()}
    best = [next(policy for policy in scores if policy in suite.RULES)]
    best += [suite.best_rule(rows, name) for name in suite.CELLS]
    rules = [f"{rule} {columns[rule][place]}" for place, rule in enumerate(best)]
    rooms = ["", *(f"{suite.room(rows, name).mean:.1f} %" for name in suite.CELLS)]
    title = f"{suite.NAME}: {suite.ZERO} has 0, {suite.ONE} has 1"
    table = make_table(title, "cell", *policies, "best rule", f"{suite.ONE} below it")
    shown = [columns[policy] for policy in policies]
    for line in zip(["mean", *suite.CELLS], *shown, rules, rooms, strict=True):
        table.add_row(*line)
    print_table(table)
