"""Run a study on test traffic, and leave its scores, figures and report in a folder.

python scripts/study.py paper              # the paper's five results, some 8,000 episodes
python scripts/study.py privacy --quick    # the price of a privacy guarantee, in minutes
python scripts/study.py ledger             # capped contributions beside paced ledgers
python scripts/study.py estimators         # every estimator under every release model
python scripts/study.py choices            # where a choice of queries pays, and what it saves
python scripts/study.py penetration        # when not every vehicle is connected
python scripts/study.py policies freeze --policies primary=results/training/primary
python scripts/study.py policies run       # learned policies against every baseline
python scripts/study.py privacy --corridor my-road.toml    # the same on a road of your own

`freeze` fixes the digests of the policies, and lets validation traffic choose the best baseline and
the best recipe; `run` takes these and no others to test traffic, once. After an interruption the
same command goes on where it stopped. Where no episode is missing, it renders the report again.
"""

from __future__ import annotations

import os

# Read when numpy loads, here and in the workers: one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from agents.environments import given_keywords
from agents.experiments.cells import Design
from agents.experiments.runner import Workplace
from agents.studies.choices import study as choice_study
from agents.studies.choices.plan import ChoiceDesign
from agents.studies.estimators import study as estimator_study
from agents.studies.estimators.plan import EstimatorDesign
from agents.studies.ledger import study as ledger_study
from agents.studies.ledger.plan import LedgerDesign
from agents.studies.paper import study as paper_study
from agents.studies.paper.plan import PaperDesign
from agents.studies.penetration import study as penetration_study
from agents.studies.penetration.plan import PenetrationDesign
from agents.studies.policies import study as policy_study
from agents.studies.policies.manifest import MANIFEST_FILE, find_checkpoints, read_tuned
from agents.studies.policies.plan import BASELINES, CELLS, PolicyCell, PolicyDesign
from agents.studies.privacy import study as privacy_study
from agents.studies.privacy.plan import PrivacyDesign
from dptse_env.config import parse_seeds
from scripts.cli import Machines, command, resumable, run

RESULTS = Path("results")


@dataclass(frozen=True)
class StudyOptions(Machines):
    """Arguments that results do not depend on."""

    output: Path | None = None
    """Folder for everything; a folder in results/ if not given."""

    def place(self, *default: str) -> Workplace:
        """Return the workplace; the default gives the parts of the name of a folder in results/."""
        return self.workplace(self.output or RESULTS / "-".join(default))


@dataclass(frozen=True)
class Paper(StudyOptions):
    """Reproduce the paper's five results, and judge its claims."""

    quick: bool = False
    """Fewer traffic seeds and fewer points of each sweep."""
    design: tyro.conf.OmitArgPrefixes[PaperDesign] = field(default_factory=PaperDesign)
    """The plan."""


@dataclass(frozen=True)
class Privacy(StudyOptions):
    """Price a guarantee of privacy, and account for the noise as printed."""

    quick: bool = False
    """Three traffic seeds and fewer points of each curve."""
    design: tyro.conf.OmitArgPrefixes[PrivacyDesign] = field(default_factory=PrivacyDesign)
    """The plan."""


@dataclass(frozen=True)
class LedgerStudy(StudyOptions):
    """Put capped contributions and paced ledgers side by side."""

    quick: bool = False
    """Three traffic seeds, fewer points of each curve, and fewer schedules."""
    design: tyro.conf.OmitArgPrefixes[LedgerDesign] = field(default_factory=LedgerDesign)
    """The plan."""


@dataclass(frozen=True)
class EstimatorStudy(StudyOptions):
    """Put all estimators side by side, with the honesty of their deviations."""

    quick: bool = False
    """Three traffic seeds, and fewer estimators and schedules."""
    design: tyro.conf.OmitArgPrefixes[EstimatorDesign] = field(default_factory=EstimatorDesign)
    """The plan."""


@dataclass(frozen=True)
class ChoiceStudy(StudyOptions):
    """Map where a choice of queries pays, and what bandwidth it saves."""

    quick: bool = False
    """Three traffic seeds, and fewer bandwidths and policies."""
    design: tyro.conf.OmitArgPrefixes[ChoiceDesign] = field(default_factory=ChoiceDesign)
    """The plan."""


@dataclass(frozen=True)
class PenetrationStudy(StudyOptions):
    """Measure errors by the share of connected vehicles, and what fusion with detectors gains."""

    quick: bool = False
    """Three traffic seeds, and fewer shares, estimators and release models."""
    design: tyro.conf.OmitArgPrefixes[PenetrationDesign] = field(default_factory=PenetrationDesign)
    """The plan."""


@dataclass(frozen=True)
class Freeze(StudyOptions):
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
    """Schedules that need no training, plan files too; unsuitable ones are left out of a cell."""
    validation_seeds: str = "1000:1064"
    """Validation traffic seeds, first:stop, within 1000:2000."""
    test_seeds: str = "2000:2064"
    """Test traffic seeds, first:stop, within 2000:3000."""
    quick: bool = False
    """The primary cell alone, on eight seeds."""
    corridor: str | None = None
    """Road in place of the cells' own: the name of a shipped corridor, a road file that ends in
    .toml, or a JSON object of corridor fields."""


@dataclass(frozen=True)
class Run(StudyOptions):
    """Run the frozen policies and choices on test traffic, and report."""


@dataclass(frozen=True)
class Policies:
    """Hold learned query policies against every baseline, on fresh traffic."""

    step: tyro.conf.OmitArgPrefixes[
        Annotated[Freeze, tyro.conf.subcommand("freeze", prefix_name=False)]
        | Annotated[Run, tyro.conf.subcommand("run", prefix_name=False)]
    ]
    """Freeze, then run."""


Study = (
    Annotated[Paper, tyro.conf.subcommand("paper")]
    | Annotated[Privacy, tyro.conf.subcommand("privacy")]
    | Annotated[LedgerStudy, tyro.conf.subcommand("ledger")]
    | Annotated[EstimatorStudy, tyro.conf.subcommand("estimators")]
    | Annotated[ChoiceStudy, tyro.conf.subcommand("choices")]
    | Annotated[PenetrationStudy, tyro.conf.subcommand("penetration")]
    | Annotated[Policies, tyro.conf.subcommand("policies")]
)


@resumable()
def main(
    args: Paper
    | Privacy
    | LedgerStudy
    | EstimatorStudy
    | ChoiceStudy
    | PenetrationStudy
    | Policies,
) -> None:
    """Run a study."""
    if isinstance(args, Paper):
        design = args.design.quick() if args.quick else args.design
        place = args.place("paper", *which(design, args.quick))
        paper_study.run(design, place, command("study.py paper", args))
    elif isinstance(args, Privacy):
        private = args.design.quick() if args.quick else args.design
        place = args.place("privacy", *which(private, args.quick))
        privacy_study.run(private, place, command("study.py privacy", args))
    elif isinstance(args, LedgerStudy):
        planned = args.design.quick() if args.quick else args.design
        place = args.place("ledger", *which(planned, args.quick))
        ledger_study.run(planned, place, command("study.py ledger", args))
    elif isinstance(args, EstimatorStudy):
        chosen = args.design.quick() if args.quick else args.design
        place = args.place("estimators", *which(chosen, args.quick))
        estimator_study.run(chosen, place, command("study.py estimators", args))
    elif isinstance(args, ChoiceStudy):
        mapped = args.design.quick() if args.quick else args.design
        place = args.place("choices", *(["quick"] if args.quick else []))
        choice_study.run(mapped, place, command("study.py choices", args))
    elif isinstance(args, PenetrationStudy):
        connected = args.design.quick() if args.quick else args.design
        place = args.place("penetration", *(["quick"] if args.quick else []))
        penetration_study.run(connected, place, command("study.py penetration", args))
    elif isinstance(args.step, Freeze):
        freeze(args.step)
        return
    else:
        place = args.step.place("policies")
        policy_study.run(place)
    print(f"report, figures and scores are in {place.folder}/")


def which(design: Design[Any], quick: bool) -> list[str]:
    """Return what tells results from those of the whole study on the environment's own road."""
    road = [] if design.corridor is None else [design.configs[0].corridor.name]
    return (["quick"] if quick else []) + road


def policy_design(args: Freeze, cells: tuple[PolicyCell, ...] = CELLS) -> PolicyDesign:
    """Return the design of the study of policies.

    Raises:
        ValueError: An argument is out of range.
    """
    road = given_keywords("{}", args.corridor)
    known = {
        cell.name: dataclasses.replace(cell, keywords={**cell.keywords, **road}) for cell in cells
    }
    unknown = [name for name in args.cells if name not in known]
    if unknown:
        raise ValueError(f"cells must be of {', '.join(known)}, got {unknown[0]!r}")
    design = PolicyDesign(
        cells=tuple(cell for name, cell in known.items() if name in args.cells),
        baselines=args.baselines,
        validation_seeds=parse_seeds(args.validation_seeds, "validation_seeds"),
        test_seeds=parse_seeds(args.test_seeds, "test_seeds"),
    )
    return design.quick() if args.quick else design


def freeze(args: Freeze, cells: tuple[PolicyCell, ...] = CELLS) -> None:
    """Freeze policies and choices, and print the choices."""
    design, place = policy_design(args, cells), args.place("policies")
    manifest, is_new = policy_study.freeze(
        design,
        place,
        command("study.py policies freeze", args),
        checkpoints=find_checkpoints(args.policies, design, args.which),
        tuned=read_tuned(args.settings),
    )
    if not is_new:
        print(f"frozen before, on {manifest.frozen}: {place.folder / MANIFEST_FILE}")
        return
    for name, choice in manifest.choices.items():
        learned = choice.learners.get(name)
        against = f"; learned: {', '.join(learned)}" if learned else ""
        print(f"{name}: best baseline {choice.baseline}{against}")
    print(f"frozen: {place.folder / MANIFEST_FILE}")


if __name__ == "__main__":
    run(main, Study, __doc__)
