"""Play a study, and report on its rows.

dptse study paper --report

It writes tables and figures of the rows in the study's folder. Without --report it first plays what
they lack.
"""

from __future__ import annotations

import dataclasses
import inspect
import pkgutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from agents.environments import parse_env
from agents.play import Cell
from agents.seeds import seed_kind
from agents.study import OWN, TABLES, Study, write_report
from agents.study import run as run_study
from dptse_env.config import parse_seeds
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import parse_json, require, require_name
from scripts.cli import Command, Environments, Machines, TestSeeds

STUDIES = {
    "paper": "agents.studies.paper:STUDY",
    "guarantees": "agents.studies.guarantees:STUDY",
    "estimators": "agents.studies.estimators:STUDY",
    "roads": "agents.studies.roads:study",
    "suite": "agents.studies.suite:STUDY",
}
RESULTS = Path("results")


@dataclass(frozen=True, kw_only=True)
class Args(Command, Machines, TestSeeds, Environments):
    """Play a study and write its report."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """paper, guarantees, estimators, roads, suite, or your own "module:NAME"; with keywords as
    JSON, 'roads {"weights": ["my-weights"]}' plays weights of your own."""
    report: bool = False
    """Write tables and figures of the rows that are there, and play nothing."""
    env: tuple[str, ...] = ()
    """Environments, 'ID {"corridor": "my-road.toml"}': only cells of these ids are played, and
    with these keywords."""
    test_seeds: str | None = None
    """Test traffic seeds, first:stop, in place of the study's own."""
    output: Path | None = None
    """Folder of the results; results/NAME if not given. Other environments, seeds or keywords
    need one of their own."""


def parse_study(text: str) -> Study:
    """Return the study given as ``NAME`` or ``NAME {JSON}``.

    Raises:
        ValueError: There is no such study, or it takes no such keywords.
    """
    name, _, rest = text.strip().partition(" ")
    keywords = parse_json(rest or "{}", "study")
    require(isinstance(keywords, dict), "study", "a name and a JSON object", rest)
    if ":" not in name:
        require_name("study", name, STUDIES)
    try:
        found: Any = pkgutil.resolve_name(STUDIES.get(name, name))
    except Exception as problem:
        raise ValueError(f"{name!r} cannot be imported: {problem}") from problem
    if callable(found):
        taken = inspect.signature(found)
        try:
            taken.bind(**keywords)
        except TypeError as problem:
            known = ", ".join(taken.parameters)
            raise ValueError(f"study {name} takes {known or 'nothing'}: {problem}") from problem
        found = found(**keywords)
    else:
        require(not keywords, f"keywords of the study {name}", "none", keywords)
    if not isinstance(found, Study):
        raise ValueError(f"{name!r} must be a Study, got {type(found).__name__}")
    return found


def find_study(args: Args) -> Study:
    """Return the study that the arguments describe.

    Raises:
        ValueError: There is no such study, or no cell of it is of the given environments.
    """
    found = parse_study(args.name)
    given = {env.rpartition(":")[2]: keywords for env, keywords in map(parse_env, args.env)}
    require(len(given) == len(args.env), "env", "of different ids", args.env)
    others = args.test_seeds and parse_seeds(args.test_seeds, "test_seeds")

    def changed(cells: Sequence[Cell]) -> list[Cell]:
        taken = []
        for cell in cells:
            more = given.get(cell.env.rpartition(":")[2]) if given else {}
            # With another value for a keyword of its own it would not be what its labels say.
            if more is not None and not more.keys() & cell.keywords.keys():
                own = cell.seeds
                if own is not None and others and seed_kind(own) != "validation":
                    own = None
                keywords = {**cell.keywords, **more}
                taken.append(dataclasses.replace(cell, keywords=keywords, seeds=own))
        return taken

    cells, follow = changed(found.cells), found.follow
    ids = sorted({cell.env for cell in found.cells})
    require(bool(cells), "env", f"of {ids}, with keywords that its cells leave open", [*given])
    if given:
        n = len(found.cells)
        args.remark(f"{len(cells)} of {n} cells are of the given environments")
        cells, reasons = _suitable(cells)
        if reasons:
            args.remark(
                f"{len(reasons)} of {n} cells do not suit what was given and are left out: "
                f"{reasons[0]}"
            )
    return dataclasses.replace(
        found,
        cells=tuple(cells),
        seeds=others or found.seeds,
        follow=follow and (lambda rows, place: changed(follow(rows, place))),
        # Further tables are measured in the study's own environments.
        measures={} if given else found.measures,
    )


def _suitable(cells: Sequence[Cell]) -> tuple[list[Cell], list[str]]:
    """Return the cells that can be played, and why the others cannot.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: None can be played.
    """
    problems = [cell.misfit() for cell in cells]
    taken = [cell for cell, problem in zip(cells, problems, strict=True) if problem is None]
    refused = [problem for problem in problems if problem is not None]
    if not taken:
        raise ValueError(refused[0])
    return taken, refused


def main(args: Args) -> None:
    """Play what is missing, and report."""
    _, _, keywords = args.name.partition(" ")
    for name, given in (("test_seeds", args.test_seeds), ("env", args.env), ("name", keywords)):
        allowed = "given with an output of its own, since the rows are others"
        require(not given or args.output is not None, name, allowed, given)
    for name in ("test_seeds", "env", "workers", "records", "address") if args.report else ():
        given = getattr(args, name)
        require(not given, name, "left out where nothing is played", given)
    study = find_study(args)
    folder = args.output or RESULTS / study.name
    require_output(folder, () if args.report else None, own=OWN)
    if args.report:
        write_report(study, folder)
    else:
        run_study(study, args.place(folder))
    written = [path for path in folder.iterdir() if path.suffix in (".parquet", ".png")]
    files = sorted(path.name for path in (*written, folder / TABLES))
    args.answer({"folder": str(folder), "files": files}, f"tables and figures are in {folder}/")
