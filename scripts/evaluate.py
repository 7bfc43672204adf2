"""Evaluate query schedules on held-out traffic, paired on traffic and noise.

python scripts/evaluate.py --schedules paper round-robin --seeds 2000:2020
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from tqdm import tqdm

from agents.evaluation import EpisodeScore, run_episode, watch_episode
from agents.figures import save_space_time
from agents.report import Report
from dptse_env.config import parse_seeds
from dptse_env.model.parameters import read_parameters
from dptse_env.schedules import SCHEDULES, Schedule, make_schedule
from dptse_env.traffic import RecordLibrary
from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """Evaluate query schedules."""

    env: str = "dptse_env:dptse/PaperHighway-v0"
    """Environment id."""
    schedules: tuple[str, ...] = tuple(SCHEDULES)
    """Query schedules; 'all' runs with a bandwidth that covers the road."""
    estimators: tuple[str, ...] = ("ekf", "random_walk")
    """State estimators."""
    seeds: str = "2000:2008"
    """Traffic seeds, first:stop; keep them apart from those used to train or calibrate."""
    reference: str = "paper"
    """Schedule that the others are compared with; added if not among them."""
    bandwidth: int | None = None
    """Most segments to query a second; the environment's own if not given."""
    parameters: str = "w99-3lane"
    """ARZ parameters: the name of a set, or a JSON file as scripts/calibrate.py writes it."""
    privacy: str = "paper"
    """Privacy preset."""
    epsilon: float = 1.0
    """Privacy parameter epsilon."""
    delta: float = 0.05
    """Privacy parameter delta."""
    noise_seed: int = 0
    """Seeds noise and estimators; one stream per traffic seed, the same for every schedule."""
    workers: int | None = None
    """Processes that record missing traffic; all cores if not given."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path = Path("results/evaluation")
    """Folder for table, scores and figures."""


def make_cell(args: Args, estimator: str, name: str) -> tuple[gym.Env[Any, Any], Schedule]:
    """Make the environment and the schedule of one cell of the table."""
    parameters: str | dict[str, Any] = args.parameters
    if args.parameters.endswith(".json"):
        parameters = dataclasses.asdict(read_parameters(args.parameters))
    keywords: dict[str, Any] = {
        "estimator": estimator,
        "parameters": parameters,
        "privacy": args.privacy,
        "epsilon": args.epsilon,
        "delta": args.delta,
        "traffic_seeds": args.seeds,
        "records": None if args.records is None else str(args.records),
    }
    if args.bandwidth is not None:
        keywords["bandwidth"] = args.bandwidth
    env = gym.make(args.env, **keywords)
    if name == "all":
        n_mainline = env.unwrapped.interface.n_mainline  # type: ignore[attr-defined]
        env = gym.make(args.env, **{**keywords, "bandwidth": n_mainline})
    return env, make_schedule(name, env, seed=args.noise_seed)


def evaluate(args: Args) -> dict[tuple[str, str], list[EpisodeScore]]:
    """Run every schedule with every estimator on every traffic seed."""
    seeds = parse_seeds(args.seeds)
    # All cells are made before the first runs: bad input shows before anything is recorded.
    cells = {
        (estimator, name): make_cell(args, estimator, name)
        for estimator in args.estimators
        for name in args.schedules
    }
    env, _ = next(iter(cells.values()))
    corridor = env.unwrapped.config.corridor  # type: ignore[attr-defined]
    library = RecordLibrary(args.records)
    library.ensure(corridor, seeds, workers=args.workers, progress=True)
    scores: dict[tuple[str, str], list[EpisodeScore]] = {key: [] for key in cells}
    with tqdm(
        total=len(cells) * len(seeds), desc="evaluating", unit="episode", mininterval=0.5
    ) as bar:
        for key, (env, schedule) in cells.items():
            for seed in seeds:
                noise = args.noise_seed + seed
                scores[key].append(run_episode(env, schedule, traffic_seed=seed, seed=noise))
                bar.update()
    return scores


def draw_traffic(args: Args, report: Report, noise: str) -> None:
    """Draw what the reference and the best schedule make of the first traffic seed."""
    estimator, seed = args.estimators[0], parse_seeds(args.seeds)[0]
    rivals = [name for name in report.ranked(estimator) if name not in (args.reference, "all")]
    histories = {}
    for name in (args.reference, *rivals[:1]):
        env, schedule = make_cell(args, estimator, name)
        noise_seed = args.noise_seed + seed
        _, histories[name] = watch_episode(env, schedule, traffic_seed=seed, seed=noise_seed)
    title = f"Traffic seed {seed}, {estimator}, {noise}"
    save_space_time(args.output / "space_time.png", histories, title)


def main(args: Args) -> None:
    """Record what is missing, evaluate, and leave table, scores and figures."""
    if args.reference not in args.schedules:
        args = dataclasses.replace(args, schedules=(*args.schedules, args.reference))
    scores = evaluate(args)
    noise = f"{args.privacy} noise at ({args.epsilon:g}, {args.delta:g})"
    env_name = args.env.rpartition("/")[2]
    n_episodes = len(parse_seeds(args.seeds))
    title = f"{env_name}, {args.parameters}, {noise}, {n_episodes} held-out episodes"
    report = Report(scores, args.reference, title)
    report.print()
    report.write(args.output, dataclasses.asdict(args))
    report.draw(args.output / "schedules.png")
    draw_traffic(args, report, noise)
    print(f"scores and figures are in {args.output}/")


if __name__ == "__main__":
    run(main, Args, __doc__)
