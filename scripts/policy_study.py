"""Hold learned query policies against every baseline, on traffic that nobody has seen before.

python scripts/policy_study.py freeze --policies primary=results/training/primary
python scripts/policy_study.py run

`freeze` notes the digests of the policies, runs everyone on validation traffic and lets that choose
the best baseline and the best recipe. `run` takes these and no others to test traffic, once, and
writes the report. Interrupted, the same command goes on where it stopped.
"""

from __future__ import annotations

import os

# Read when numpy loads, here and in the workers: one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.provenance import take_folder
from agents.experiments.runner import run_all
from agents.experiments.seeds import STUDY_TEST, STUDY_VALIDATION
from agents.studies.policies.curves import read_curves
from agents.studies.policies.freezing import (
    ASKED,
    TEST,
    VALIDATION,
    begin,
    check_untouched,
    choose,
    design_of,
    draft,
    origin_of,
)
from agents.studies.policies.manifest import Manifest, find_checkpoints, read_tuned
from agents.studies.policies.plan import (
    BASELINES,
    CELLS,
    DETERMINISTIC,
    PRIMARY,
    Design,
    Entry,
    quick,
)
from agents.studies.policies.queries import Asked
from agents.studies.policies.report import draw, write_report
from agents.studies.policies.results import Measured
from agents.studies.policies.running import (
    config_of,
    lacking,
    make_task,
    run_entry,
    watch_entry,
)
from dptse_env.config import parse_seeds
from dptse_env.traffic import RecordLibrary
from dptse_env.validation import integer
from scripts.cli import command, resumable, run

FOLDER = Path("results/policies")


@dataclass(frozen=True)
class Freeze:
    """Fix policies and choices before test traffic is touched."""

    policies: tuple[str, ...] = ()
    """Trained policies, each cell=path or cell:name=path: a saved policy, a run folder, or a folder
    of those; the name is that of the recipe if not given."""
    which: str = "best.zip"
    """File to take from a run folder: best.zip (best in validation) or policy.zip (the last)."""
    settings: tuple[str, ...] = ()
    """Estimator settings tuned for one policy, each policy=file as scripts/tune.py writes it."""
    cells: tuple[str, ...] = tuple(cell.name for cell in CELLS)
    """Cells to run, the primary one among them."""
    baselines: tuple[str, ...] = BASELINES
    """Schedules that need no training, plan files too; what does not suit a cell is left out."""
    validation_seeds: str = "1000:1064"
    """Validation traffic seeds, first:stop, within 1000:2000."""
    test_seeds: str = "2000:2064"
    """Test traffic seeds, first:stop, within 2000:3000."""
    quick: bool = False
    """The primary cell alone, on eight seeds."""
    workers: int = os.cpu_count() or 1
    """Processes that record missing traffic and run policies."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path = FOLDER
    """Folder for everything."""


@dataclass(frozen=True)
class Run:
    """Take what was frozen to test traffic, and report."""

    workers: int = os.cpu_count() or 1
    """Processes that record missing traffic and run policies."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path = FOLDER
    """Folder in which policies were frozen."""


def design_from(args: Freeze) -> Design:
    """Return what the arguments ask to run."""
    known = {cell.name: cell for cell in CELLS}
    strangers = [name for name in args.cells if name not in known]
    if strangers:
        raise ValueError(f"cells must be of {', '.join(known)}, got {strangers[0]!r}")
    cells = tuple(cell for name, cell in known.items() if name in args.cells)
    design = Design(
        cells=cells,
        baselines=args.baselines,
        validation_seeds=parse_seeds(args.validation_seeds, "validation_seeds"),
        test_seeds=parse_seeds(args.test_seeds, "test_seeds"),
    )
    return quick(design) if args.quick else design


def main(args: Freeze | Run) -> None:
    """Freeze or run."""
    integer("workers", args.workers, 1)
    with resumable():
        freeze(args) if isinstance(args, Freeze) else test(args)


def freeze(args: Freeze) -> None:
    """Fix policies and choices."""
    design = design_from(args)
    check_untouched(args.output)
    own = draft(
        design,
        find_checkpoints(args.policies, design, args.which),
        read_tuned(args.settings),
        command("policy_study", args).replace(".py", ".py freeze", 1),
    )
    take_folder(args.output, origin_of(design))
    manifest = begin(args.output, own)
    if manifest.frozen:
        print(f"frozen before, on {manifest.frozen}: {args.output / 'manifest.json'}")
        return
    ledger = Ledger(args.output / VALIDATION, Entry, EpisodeScore)
    entries = manifest.entries(design, bounds=False)
    _run(args, design, manifest, entries, ledger, run_entry, design.validation_seeds)
    manifest = choose(design, manifest, ledger)
    manifest.write(args.output)
    for name, choice in manifest.choices.items():
        learned = choice.learners.get(name)
        against = f"; learned: {', '.join(learned)}" if learned else ""
        print(f"{name}: best baseline {choice.baseline}{against}")
    print(f"frozen: {args.output / 'manifest.json'}")


def test(args: Run) -> None:
    """Take what was frozen to test traffic, and report."""
    manifest = Manifest.read(args.output)
    if not manifest.frozen:
        raise ValueError(f"{args.output} is not frozen yet: run the same `freeze` to its end first")
    design = design_of(manifest.design)
    for checkpoint in manifest.checkpoints:
        checkpoint.saved()
    origin = take_folder(args.output, origin_of(design))
    entries = manifest.entries(design)
    episodes = Ledger(args.output / TEST, Entry, EpisodeScore)
    _run(args, design, manifest, entries, episodes, run_entry, design.test_seeds)
    asked = Ledger(args.output / ASKED, Entry, Asked)
    watched = [own for own in entries if own.cell == PRIMARY and own.mode == DETERMINISTIC]
    _run(args, design, manifest, watched, asked, watch_entry, design.test_seeds)
    curves = read_curves(manifest.checkpoints, PRIMARY)
    measured = Measured(design, manifest, episodes.rows, asked.rows, curves)
    draw(args.output, measured)
    write_report(args.output / "REPORT.md", measured, origin)
    print(f"report, figures and scores are in {args.output}/")


def _run(
    args: Freeze | Run,
    design: Design,
    manifest: Manifest,
    entries: Sequence[Entry],
    ledger: Ledger[Entry, Any],
    work: Callable[[Any], list[Any]],
    seeds: tuple[int, ...],
) -> None:
    """Run what a ledger lacks, on validation or test traffic."""
    noise = STUDY_VALIDATION.start if seeds == design.validation_seeds else STUDY_TEST.start
    missing = lacking(entries, seeds, ledger)
    library = RecordLibrary(args.records)
    for name in dict.fromkeys(entry.cell for entry in missing):
        corridor = config_of(design.cell(name), seeds).corridor
        library.ensure(corridor, seeds, args.workers, progress=True)
    tasks = [
        make_task(
            entry,
            design,
            manifest,
            seeds=seeds,
            noise=noise,
            records=None if args.records is None else str(args.records),
            threads=1 if args.workers > 1 else None,
        )
        for entry in missing
    ]
    run_all(tasks, ledger, args.workers, work=work)
    ledger.sort()


if __name__ == "__main__":
    run(main, Freeze | Run, __doc__)  # type: ignore[arg-type]
