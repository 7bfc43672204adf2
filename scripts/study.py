"""Play a study and write its report, or write the report of the rows that are there.

python scripts/study.py paper --report
python scripts/study.py guarantees --quick
python scripts/study.py my_package.my_study:STUDY
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from dataclasses import dataclass
from pathlib import Path

import tyro

from agents.files import refuse_to_replace
from agents.study import TABLES, Study, write_report
from agents.study import run as run_study
from dptse_env.config import parse_seeds
from scripts.cli import Machines, resumable, run

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
    """Traffic seeds, first:stop, in place of the study's own: needs another output."""
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
    cells = found.cells
    if args.seeds is not None:
        cells = tuple(dataclasses.replace(cell, seeds=None) for cell in cells)
    if args.quick:
        seeds = seeds[:QUICK_SEEDS]
        cells = tuple(
            dataclasses.replace(cell, seeds=cell.seeds and cell.seeds[:QUICK_SEEDS])
            for cell in cells
        )
    study: Study = dataclasses.replace(found, cells=cells, seeds=seeds)
    return study


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


@resumable()
def main(args: Args) -> None:
    """Play what is missing, and report."""
    study = find_study(args)
    folder = args.output or RESULTS / f"{study.name}{'-quick' if args.quick else ''}"
    if args.seeds is not None and args.output is None:
        refuse_to_replace([folder / TABLES], force=False)
    if args.report:
        write_report(study, folder)
    else:
        run_study(study, args.place(folder))
    print(f"tables and figures are in {folder}/")


if __name__ == "__main__":
    run(main, Args, __doc__)
