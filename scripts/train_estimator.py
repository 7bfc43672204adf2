"""Train a recurrent network as an estimator, in a folder.

python scripts/train_estimator.py --seed 0 --output results/filters/0

The folder gets plan.json, progress.csv (the learning curve), checkpoint.pt and the file of weights
that ``estimator_settings={"recurrent": {"weights": "<folder>/network.safetensors"}}`` takes.
After an interruption, or a kill, the same command continues from the last checkpoint to the same
numbers; other arguments need another folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch

from agents.environments import make_config, parse_env
from agents.filters.plan import FilterPlan, Round
from agents.filters.scenarios import ScenarioRanges
from agents.filters.training import FilterTraining
from agents.training.run_files import check_plan
from dptse_env.config import parse_seeds
from dptse_env.estimators.recurrent import read_network
from dptse_env.utils.fields import integer
from scripts.cli import Machines
from scripts.training_bar import Bar, watched


@dataclass(frozen=True)
class Args(Machines):
    """Train a recurrent network as an estimator."""

    seed: int = 0
    """Training seed."""
    traffic: str = "0:96"
    """Traffic seeds to train on, first:stop; training seeds only."""
    validation: str = "1000:1016"
    """Traffic seeds to validate on, first:stop; validation seeds only."""
    validation_envs: tuple[str, ...] = FilterPlan.validation_envs
    """Environments to validate in, with a round robin."""
    width: int | None = None
    """Width of the hidden state of a cell; that of the initial network, or 64, if not given."""
    initial: str | None = None
    """Network to begin with in place of random weights: the name of one that ships, such as
    highway-flows, or a file. Rounds may then begin with 'own'."""
    episodes: int | None = None
    """Episodes of a scenario, each on another traffic seed, and of a batch; 32, or as many as there
    are traffic seeds to train on, if not given."""
    learning_rate: float = FilterPlan.learning_rate
    """Learning rate at the beginning."""
    likelihood: float = FilterPlan.likelihood
    """Weight of the likelihood in the loss."""
    rounds: tuple[str, ...] = ("ekf:72:200", "own:72:300", "own:72:400")
    """Rounds as estimator:scenarios:passes; 'own' is the network that is trained."""
    ranges: ScenarioRanges = field(default_factory=ScenarioRanges)
    """Ranges that scenarios are drawn from."""
    checkpoint_every: int = 20
    """Passes between two checkpoints, each with a validation."""
    threads: int = 1
    """Threads of torch; numbers depend on it in the last digits."""
    compiled: bool = False
    """Compile the step, which takes a C++ compiler and makes passes some 1.6 times as fast; numbers
    depend on it in the last digits."""
    tensorboard: bool = True
    """Write the learning curve for TensorBoard, too, where that is installed."""
    output: Path = Path("results/filters/0")
    """Folder of the training."""


def parse_round(text: str) -> Round:
    """Return a round, given as estimator:scenarios:passes.

    Raises:
        ValueError: The text has another form, or a number is out of range.
    """
    parts = text.split(":")
    if len(parts) != 3 or not all(part.isdecimal() for part in parts[1:]):
        raise ValueError(f"rounds must be like 'ekf:72:200', got {text!r}")
    return Round(parts[0], int(parts[1]), int(parts[2]))


def make_plan(args: Args) -> FilterPlan:
    """Return the plan that the arguments describe.

    Raises:
        ValueError: An argument is out of range.
    """
    traffic, width = parse_seeds(args.traffic, "traffic"), args.width
    if width is None:
        network = read_network(args.initial).network if args.initial else None
        width = FilterPlan.width if network is None else network.hidden.shape[0]
    return FilterPlan(
        seed=args.seed,
        traffic_seeds=traffic,
        validation_seeds=parse_seeds(args.validation, "validation"),
        validation_envs=args.validation_envs,
        ranges=args.ranges,
        rounds=tuple(parse_round(each) for each in args.rounds),
        width=width,
        initial=args.initial,
        episodes=min(FilterPlan.episodes, len(traffic)) if args.episodes is None else args.episodes,
        learning_rate=args.learning_rate,
        likelihood=args.likelihood,
        checkpoint_every=args.checkpoint_every,
    )


def main(args: Args) -> None:
    """Record missing traffic, train, and leave the network."""
    plan = make_plan(args)
    torch.set_num_threads(integer("threads", args.threads, 1))
    plan.check()
    check_plan(args.output, plan.settings())
    executor = args.start_executor()
    for envs, seeds in (
        (plan.ranges.envs, plan.traffic_seeds), (plan.validation_envs, plan.validation_seeds)
    ):  # fmt: skip
        for env in envs:
            args.library(make_config(*parse_env(env)).corridor, seeds)
    bar = Bar("update", ("error", "validation", "chi2"), plan.n_passes, unit="pass")
    with watched(bar, args.output, args.tensorboard) as watchers:
        training = FilterTraining(
            plan,
            args.output,
            records=args.records,
            watchers=watchers,
            progress=bar.show,
            compiled=args.compiled,
            executor=executor,
        )
        training.run()
    print(f"the network is in {args.output / 'network.safetensors'}")
