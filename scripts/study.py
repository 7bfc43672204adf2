"""Play a study, and report on its rows.

dptse study paper --report

It plays what the rows in its folder lack, and writes tables and figures of all.
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from agents.environments import parse_env
from agents.play import Cell
from agents.seeds import seed_kind
from agents.study import OWN, Study, write_report
from agents.study import run as run_study
from dptse_env.config import parse_seeds
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import require
from scripts.cli import Machines

STUDIES = ("paper", "guarantees", "estimators", "roads", "policies", "suite")
RESULTS = Path("results")
QUICK_SEEDS = 3


@dataclass(frozen=True, kw_only=True)
class Args(Machines):
    """Play a study and write its report."""

    name: tyro.conf.Positional[str]
    """paper, guarantees, estimators, roads, policies, suite, or your own "module:NAME"."""
    report: bool = False
    """Write tables and figures of the rows that are there, and play nothing."""
    quick: bool = False
    """Three traffic seeds for each cell, to see whether it runs."""
    seeds: str | None = None
    """Test traffic seeds, first:stop, in place of its own; needs another output."""
    env: tuple[str, ...] = ()
    """Environments, 'ID {"corridor": "my-road.toml"}': only cells of these ids are played, and
    with these keywords; needs another output."""
    train: float | None = None
    """Minutes of each training of the study of policies, which trains what is missing first."""
    training_seeds: str = "0:5"
    """Seeds of these trainings, first:stop: every learner has the first, the best two all."""
    weights: tuple[str, ...] = ()
    """Weights for the studies of roads and estimators: names, or paths without
    "-flows.safetensors" and "-speeds.safetensors"; need another output."""
    output: Path | None = None
    """Folder of the results; results/NAME if not given, with "-quick" for quick ones."""


def find_study(args: Args) -> Study:
    """Return the study that the arguments describe.

    Raises:
        ValueError: There is no such study, or an argument is of another one.
    """
    for argument, names in (("train", ("policies",)), ("weights", ("estimators", "roads"))):
        if getattr(args, argument) and args.name not in names:
            raise ValueError(
                f"{argument} is an argument of the study {' or '.join(names)}, not of {args.name!r}"
            )
    if args.weights:
        found: Study = importlib.import_module(f"agents.studies.{args.name}").study(args.weights)
    elif args.name in STUDIES:
        found = importlib.import_module(f"agents.studies.{args.name}").STUDY
    elif ":" in args.name:
        found = _own(args.name)
    else:
        raise ValueError(f"study must be one of {', '.join(STUDIES)}, got {args.name!r}")
    given = {env.rpartition(":")[2]: keywords for env, keywords in map(parse_env, args.env)}
    require(len(given) == len(args.env), "env", "of different ids", args.env)
    seeds = found.seeds if args.seeds is None else parse_seeds(args.seeds)
    most = QUICK_SEEDS if args.quick else None

    def changed(cells: Sequence[Cell]) -> list[Cell]:
        taken = []
        for cell in cells:
            more = given.get(cell.env.rpartition(":")[2]) if given else {}
            # With another value for a keyword of its own it would not be what its labels say.
            if more is not None and not more.keys() & cell.keywords.keys():
                own = cell.seeds
                if own is not None and args.seeds is not None and seed_kind(own) != "validation":
                    own = None
                keywords = {**cell.keywords, **more}
                taken.append(dataclasses.replace(cell, keywords=keywords, seeds=own and own[:most]))
        return taken

    cells, follow = changed(found.cells), found.follow
    ids = sorted({cell.env for cell in found.cells})
    require(bool(cells), "env", f"of {ids}, with keywords that its cells leave open", [*given])
    if given:
        n = f"{len(cells)} of {len(found.cells)} cells"
        print(f"{n} are of the given environments", file=sys.stderr)
    return dataclasses.replace(
        found,
        cells=_suitable(cells) if given else tuple(cells),
        seeds=seeds[:most],
        follow=follow and (lambda rows, folder: changed(follow(rows, folder))),
        # Further tables are measured in the study's own environments.
        measures={} if given else found.measures,
    )


def _suitable(cells: Sequence[Cell]) -> tuple[Cell, ...]:
    """Return the cells that can be played, and say how many suit no given environment, and why.

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
        print(f"{n} do not suit what was given and are left out: {refused[0]}", file=sys.stderr)
    return tuple(taken)


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
    for name in ("seeds", "env", "weights"):
        require(
            not getattr(args, name) or args.output is not None,
            name,
            "given with an output of its own, since the rows are others",
            getattr(args, name),
        )
    require_output(folder, () if args.report else None, own=OWN)
    if args.report:
        write_report(study, folder)
        print(f"tables and figures are in {folder}/")
        return
    place = args.place(folder)
    if args.train is not None:
        from agents.studies.policies.trainings import train_ladder  # noqa: PLC0415 (needs torch)

        train_ladder(study, place, args.train, parse_seeds(args.training_seeds, "training_seeds"))
    run_study(study, place)
    print(f"tables and figures are in {folder}/")
