"""Time of an estimator's step: compiled, the reference, and their peers.

python benchmarks/bench_estimators.py

A step is `predict` and `update` of one episode, 28 outputs, on one core; all rows are measured in
turns in one run. Compare the ratios: absolute times drift between machines and moments.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass
from typing import NamedTuple

from benchmarks.compile_time import cold_and_warm
from benchmarks.peers import SolverPeer, peers
from benchmarks.replay import Replay, recorded
from benchmarks.timing import Row, Steps, interleave
from dptse_env.config import parse_seeds
from dptse_env.estimators import check_estimator
from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """Time a step of each estimator."""

    parameters: str = "w99-3lane"
    """ARZ parameter set."""
    traffic_seeds: str = "0:4"
    """Traffic seeds of the episodes, first:stop; single episodes replay the first."""
    queried: int = 11
    """Segments queried a step beside the three with a sensor."""
    batch: int = 64
    """Episodes in a batch."""
    steps: int = 700
    """Steps of an episode, from the empty road on."""
    block: int = 50
    """Steps of one row before the next one has its turn."""
    passes: int = 3
    """Times that all rows go through the steps; a step's time is the median."""
    compile_time: bool = True
    """Whether to measure what compiling costs, too."""
    quick: bool = False
    """Smallest sizes: whether it runs, not how fast."""


class Aim(NamedTuple):
    """Times [us] to reach."""

    target: float
    goal: float


AIMS = {
    "ekf": Aim(20.0, 14.0),
    "ukf": Aim(60.0, 50.0),
    "enkf": Aim(120.0, 90.0),
    "mhe": Aim(700.0, 200.0),
}


class Group(NamedTuple):
    """The rows of one estimator; the first one is the compiled one, alone."""

    steps: list[Steps]
    peers: list[Row]

    @property
    def rows(self) -> list[Row]:
        """All that run."""
        return [*self.steps, *self.peers]


def group_of(estimator: str, replay: Replay, block: int) -> Group:
    """Build the rows of an estimator."""
    one, n = replay.first(1), len(replay.start)
    steps = [
        Steps(estimator, "compiled", "compiled, one episode", one),
        Steps(estimator, "compiled", f"compiled, batch of {n}", replay),
    ]
    if has_reference(estimator):
        steps.append(Steps(estimator, "reference", "reference", one))
    return Group(steps, peers(estimator, one, block))


def has_reference(estimator: str) -> bool:
    """Whether the package has a reference of an estimator."""
    try:
        check_estimator(estimator, "reference")
    except ValueError:
        return False
    return True


def print_table(groups: dict[str, Group]) -> None:
    """Print a line a row; the ratio is to the quickest peer."""
    print(
        f"{'':6}{'':24}{'us/step':>9}{'95 %':>9}{'peer/it':>9}"
        f"{'target':>8}{'':>5}{'goal':>7}{'':>5}{'estimate()':>12}"
    )
    for estimator, group in groups.items():
        peer = min(row.mean for row in group.peers)
        for row in group.rows:
            line = f"{estimator:6}{row.label:24}{row.mean:9.1f}{row.percentile_95:9.1f}"
            line += f"{peer / row.mean:9.2f}"
            if isinstance(row, Steps):
                if row.label.startswith("compiled"):
                    for aim in AIMS[estimator]:
                        line += f"{aim:7.0f}{'met' if row.mean <= aim else 'no':>5} "
                line = f"{line:79}{row.reading.mean:12.1f}"
            print(line)


def print_remarks(groups: dict[str, Group]) -> None:
    """Print what became of the filters and the programs while they were timed."""
    for estimator, group in groups.items():
        for row in group.steps:
            if row.n_diverged:
                print(f"{estimator}, {row.label}: diverged {row.n_diverged} times")
    if "mhe" in groups:
        alone, batch = groups["mhe"].steps[:2]
        print(f"MHE: programs passed on to piqp: {alone.n_passed_on} alone, "
              f"{batch.n_passed_on} in the batch")  # fmt: skip
        for row in groups["mhe"].peers:
            if isinstance(row, SolverPeer):
                print(f"{row.label}: bounds bind in {row.n_bound} of {row.n_solved} programs")


def print_compile_times() -> None:
    """Print the first step of each estimator without numba's cache and with it."""
    print(
        f"\nfirst step [s]  {'cold':>8}{'cached':>8}   a process each, an empty cache for the first"
    )
    for estimator in AIMS:
        cold, warm = cold_and_warm(estimator)
        print(f"{estimator:16}{cold:8.1f}{warm:8.2f}")


def main(args: Args) -> None:
    """Measure and print."""
    batch, steps, block, passes = args.batch, args.steps, args.block, args.passes
    if args.quick:
        batch, steps, block, passes = 2, 16, 8, 1
    seeds = parse_seeds(args.traffic_seeds, "traffic_seeds")
    if args.quick:
        seeds = seeds[:1]
    replay = recorded(args.parameters, seeds, batch, args.queried, steps)
    groups = {estimator: group_of(estimator, replay, block) for estimator in AIMS}
    interleave([row for group in groups.values() for row in group.rows], steps, block, passes)
    settings = replay.settings
    print(
        f"{replay.n_outputs} outputs, {settings.enkf.n_members} members, N = "
        f"{settings.mhe.horizon}; seconds 0 to {steps} of SUMO records, traffic seeds "
        f"{args.traffic_seeds}, paper's schedule, OMP_NUM_THREADS "
        f"{os.environ['OMP_NUM_THREADS']}, median of {passes}"
    )
    print_table(groups)
    print_remarks(groups)
    if args.compile_time and not args.quick:
        print_compile_times()


if __name__ == "__main__":
    run(main, Args, __doc__)
