r"""Train a recurrent network as an estimator in a folder, and go on there after an interruption.

dptse train-estimator --env dptse_env:dptse/ShortHighway-v0 --traffic 0:4 --validation 1000:1001 \
    --validation-env dptse_env:dptse/ShortHighway-v0 --rounds ekf:2:4 own:2:4 --output results/net

The folder gets network.safetensors, which the environment takes with the keywords that the command
prints, progress.csv (the learning curve), plan.json (the settings) and checkpoint.pt. The same
command goes on from the last checkpoint to the same numbers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch

from agents.environments import make_config, parse_env
from agents.filters.plan import FilterPlan, Round
from agents.filters.scenarios import ScenarioRanges
from agents.filters.training import WEIGHTS, FilterTraining
from agents.training.run_files import check_plan
from dptse_env.config import parse_seeds
from dptse_env.estimators.recurrent import read_network
from dptse_env.utils.fields import from_mapping, integer, parse_json
from scripts.cli import Machines
from scripts.training_bar import Bar, watched


@dataclass(frozen=True)
class Args(Machines):
    """Train a recurrent network as an estimator."""

    env: tuple[str, ...] = ()
    """Environments to train on, each an id or 'id {keywords as JSON}', with privacy, bandwidth and
    query policy drawn at random; eight roads if not given."""
    traffic: str = "0:96"
    """Traffic seeds to train on, first:stop, of 0 to 999."""
    validation_env: tuple[str, ...] = FilterPlan.validation_envs
    """Environments to validate in, with a round robin."""
    validation: str = "1000:1016"
    """Traffic seeds to validate on, first:stop, of 1000 to 1999."""
    rounds: tuple[str, ...] = ("ekf:72:200", "own:72:300", "own:72:400")
    """Rounds as estimator:scenarios:passes; 'own' is the network that is trained."""
    initial: str | None = None
    """Network to begin with, a name such as highway-flows or a file; rounds may then all be own."""
    plan: str = "{}"
    """Further fields of the plan as JSON, such as '{"ranges": {"mechanisms": ["paced"]}}'; see
    agents/filters/plan.py."""
    seed: int = 0
    """Training seed."""
    threads: int = 1
    """Threads of torch; numbers depend on it in the last digits."""
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
    traffic, width = parse_seeds(args.traffic, "traffic"), FilterPlan.width
    if args.initial is not None:
        width = read_network(args.initial).network.width
    plan = FilterPlan(
        seed=args.seed,
        traffic_seeds=traffic,
        validation_seeds=parse_seeds(args.validation, "validation"),
        validation_envs=args.validation_env,
        ranges=ScenarioRanges(envs=args.env) if args.env else ScenarioRanges(),
        rounds=tuple(parse_round(each) for each in args.rounds),
        width=width,
        initial=args.initial,
        episodes=min(FilterPlan.episodes, len(traffic)),
    )
    return from_mapping(FilterPlan, parse_json(args.plan, "plan"), "plan", plan)


def main(args: Args) -> None:
    """Record missing traffic, train, and print the keywords that take the network."""
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
    with watched(bar, args.output) as watchers:
        FilterTraining(
            plan,
            args.output,
            records=args.records,
            watchers=watchers,
            progress=bar.show,
            executor=executor,
        ).run()
    settings = {"recurrent": {"weights": str(args.output / WEIGHTS)}}
    print("as keywords of an environment:")
    print(json.dumps({"estimator": "recurrent", "estimator_settings": settings}))
