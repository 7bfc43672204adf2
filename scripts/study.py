"""Play a study and write its report, or write the report of the rows that are there.

python scripts/study.py paper --report
python scripts/study.py guarantees --quick
python scripts/study.py my_package.my_study:STUDY
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from agents.environments import parse_env
from agents.play import Cell
from agents.seeds import seed_kind
from agents.study import Follow, Study, write_report
from agents.study import run as run_study
from dptse_env.config import parse_seeds
from dptse_env.utils.fields import require
from scripts.cli import Machines
from scripts.suite import suitable

STUDIES = ("paper", "guarantees", "estimators", "policies", "suite")
RESULTS = Path("results")
QUICK_SEEDS = 3


@dataclass(frozen=True, kw_only=True)
class Args(Machines):
    """Play a study and write its report."""

    name: tyro.conf.Positional[str]
    """paper, guarantees, estimators, policies, suite, or a study of your own as "module:NAME"."""
    report: bool = False
    """Write tables and figures of the rows that are there, and play nothing."""
    quick: bool = False
    """Three traffic seeds for each cell, to see whether it runs."""
    seeds: str | None = None
    """Test traffic seeds, first:stop, in place of the study's own; needs another output. What is
    played on validation traffic keeps its seeds."""
    env: tuple[str, ...] = ()
    """Environments, 'ID {"corridor": "my-road.toml"}': the study's cells with one of these ids are
    played with its keywords, and no others; needs another output."""
    policies: tuple[str, ...] = ()
    """Trained policies for the study of policies, each name=path."""
    output: Path | None = None
    """Folder of the results; results/NAME if not given, with "-quick" for quick ones."""


def find_study(args: Args) -> Study:
    """Return the study that the arguments describe.

    Raises:
        ValueError: There is no such study, or an argument is of another one.
    """
    if args.policies and args.name != "policies":
        raise ValueError(f"policies are arguments of the study policies, not of {args.name!r}")
    if args.policies:
        from agents.studies.policies import study as with_policies  # noqa: PLC0415

        found = with_policies(args.policies)
    elif args.name in STUDIES:
        found = importlib.import_module(f"agents.studies.{args.name}").STUDY
    elif ":" in args.name:
        found = _own(args.name)
    else:
        raise ValueError(f"study must be one of {', '.join(STUDIES)}, got {args.name!r}")
    seeds = found.seeds if args.seeds is None else parse_seeds(args.seeds)
    given, most = dict(map(parse_env, args.env)), QUICK_SEEDS if args.quick else None

    def changed(cell: Cell) -> Cell:
        own = cell.seeds
        if own is not None and args.seeds is not None and seed_kind(own) != "validation":
            own = None
        own = None if own is None else own[:most]
        keywords = {**cell.keywords, **given.get(cell.env, {})}
        return dataclasses.replace(cell, keywords=keywords, seeds=own)

    follow = found.follow
    if follow is not None:
        follow = _changed_too(follow, changed)
    cells = tuple(map(changed, _of(found.cells, given) if given else found.cells))
    if given:
        cells = suitable(cells, "what was given")
    # Further tables are measured in the study's own environments.
    measures = {} if given else found.measures
    return dataclasses.replace(
        found, cells=cells, seeds=seeds[:most], follow=follow, measures=measures
    )


def _of(cells: Sequence[Cell], given: Mapping[str, Mapping[str, Any]]) -> tuple[Cell, ...]:
    """Return the cells of the given environments, and say how many are left out.

    So are cells with a value of their own for a given keyword: with another one they would not be
    what their labels say.

    Raises:
        ValueError: All are.
    """
    taken = tuple(
        cell for cell in cells if cell.env in given and not given[cell.env].keys() & cell.keywords
    )
    if not taken:
        ids = sorted({cell.env for cell in cells})
        raise ValueError(
            f"env must be one of {ids} with keywords that cells of the study leave open, "
            f"got {list(given)}"
        )
    if len(taken) < len(cells):
        n = f"{len(cells) - len(taken)} of {len(cells)} cells"
        print(f"{n} are of other environments and are left out", file=sys.stderr)
    return taken


def _changed_too(follow: Follow, changed: Callable[[Cell], Cell]) -> Follow:
    """Return a function whose cells are changed as those that are played first."""
    return lambda rows, folder: [changed(cell) for cell in follow(rows, folder)]


def _own(name: str) -> Study:
    """Return a study of somebody's own.

    Raises:
        ValueError: It cannot be imported, or is no study.
    """
    try:
        found = pkgutil.resolve_name(name)
    except Exception as problem:
        raise ValueError(f"{name!r} cannot be imported: {problem}") from problem
    if not isinstance(found, Study):
        raise ValueError(f"{name!r} must be a Study, got {type(found).__name__}")
    return found


def main(args: Args) -> None:
    """Play what is missing, and report."""
    study = find_study(args)
    folder = args.output or RESULTS / f"{study.name}{'-quick' if args.quick else ''}"
    for name in ("seeds", "env"):
        require(
            not getattr(args, name) or args.output is not None,
            name,
            "given with an output of its own, since the rows are others",
            getattr(args, name),
        )
    if args.report:
        write_report(study, folder)
    else:
        run_study(study, args.place(folder))
    print(f"tables and figures are in {folder}/")
