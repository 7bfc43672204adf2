"""Score a query policy in the cells of the query suite, and write its card.

dptse suite speed-front --cells short

Scores stand beside the best rule's; the mean is over all cells. What a folder has of an earlier
run with equal numbers is not played again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl
import tyro

from agents.files import write_json
from agents.play import Cell
from agents.policies import policy_name
from agents.studies import suite
from agents.study import OWN, Study, play_study
from agents.tables import are_present
from agents.terminal import make_table, print_table
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import require, require_name
from scripts.cli import Machines

CARD = "card.json"


@dataclass(frozen=True, kw_only=True)
class Args(Machines):
    """Score a query policy in the cells of the query suite, and write its card."""

    policies: tyro.conf.Positional[tuple[str, ...]]
    """Schedules; saved policies by file or shipped name; "module:Class". Where there are several,
    the first that suits a cell acts in it."""
    cells: tuple[str, ...] = ()
    """Cells by name; all of them if none is given."""
    beside: tuple[Path, ...] = ()
    """Cards of other policies, to be shown beside it."""
    output: Path | None = None
    """Folder of the card and the rows; one below results/my-suite if not given."""


def main(args: Args) -> None:
    """Play what was entered, write its card, and print scores."""
    require(bool(args.policies), "policies", "one or more", args.policies)
    others = [suite.read_card(path) for path in args.beside]
    for name in args.cells:
        require_name("cells", name, list(suite.CELLS))
    cells = enter(args.policies, args.cells or tuple(suite.CELLS))
    (entry,) = {each.labels["policy"] for each in cells}
    # A schedule by "module:Class" has a character that not every system allows in a path.
    folder = args.output or Path("results/my-suite") / entry.replace(":", "-")
    require_output(folder, own=OWN)
    study = Study("suite", cells, suite.SEEDS, lambda rows, folder: "")
    place, recorded = args.place(folder), suite.recorded_rows()
    played = play_study(study, place)
    # The folder may have rows of other policies, of an earlier state of this one's file, and of
    # this one under another name.
    present = pl.col("cell").is_in([each.id for each in cells])
    own = played.filter(present, are_present(played)).with_columns(policy=pl.lit(entry))
    rows: pl.DataFrame = pl.concat([recorded, *others, own], how="diagonal_relaxed")
    rows = rows.unique(("policy", "name", "traffic_seed"), keep="last")
    write_json(folder / CARD, suite.make_card(rows, entry, cells))
    print_scores(rows, [entry, *(each["policy"][0] for each in others)])
    print(f"the card is {folder / CARD}")


def enter(policies: Sequence[str], names: Sequence[str]) -> tuple[Cell, ...]:
    """Return cells with the first policy that suits each, and say which are left out, and why.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: One of the policies acts in no cell.
    """
    entry = "+".join(map(policy_name, policies))
    reasons = dict.fromkeys(policies, "those before it act in all cells")
    found, left_out = {}, {}
    for name in names:
        for source in policies:
            cell = suite.make_cell(name, entry, source)
            try:
                cell.check()
            except ValueError as problem:
                left_out[name] = reasons[source] = str(problem)
            else:
                found[name] = cell
                break
    acting = {cell.policy for cell in found.values()}
    idle = [source for source in policies if source not in acting]
    if idle:
        raise ValueError(f"{idle[0]!r} acts in no cell: {reasons[idle[0]]}")
    missing = [name for name in names if name not in found]
    if missing:
        which = ", ".join(missing)
        print(f"{entry} does not suit {which}: {left_out[missing[0]]}", file=sys.stderr)
    return tuple(found.values())


def print_scores(rows: pl.DataFrame, policies: Sequence[str]) -> None:
    """Print scores by cell, those of the best rule beside them, and what the oracle gains."""
    scores = suite.score_all(rows)
    columns = {policy: suite.format_scores(each) for policy, each in scores.items()}
    best = [next(policy for policy in scores if policy in suite.RULES)]
    best += [suite.best_rule(rows, name) for name in suite.CELLS]
    rules = [f"{rule} {columns[rule][place]}" for place, rule in enumerate(best)]
    rooms = ["", *(f"{suite.room(rows, name).mean:.1f} %" for name in suite.CELLS)]
    title = f"{suite.NAME}: {suite.ZERO} has 0, {suite.ONE} has 1"
    table = make_table(title, "cell", *policies, "best rule", f"{suite.ONE} below best rule")
    shown = [columns[policy] for policy in policies]
    for line in zip(["mean", *suite.CELLS], *shown, rules, rooms, strict=True):
        table.add_row(*line)
    print_table(table)
