"""Evaluate query schedules and trained policies on held-out traffic, paired on traffic and noise.

python scripts/evaluate.py --schedules paper round-robin --seeds 2000:2020
python scripts/evaluate.py --policies results/training/primary/pl-0/best.zip
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from tqdm import tqdm

from agents.evaluation.episodes import (
    EpisodeScore,
    Policy,
    make_vector,
    run_episodes,
    watch_episode,
)
from agents.evaluation.figures import save_space_time
from agents.evaluation.policies import Saved
from agents.evaluation.report import Report
from dptse_env.config import EnvConfig, parse_seeds
from dptse_env.model.parameters import read_parameters
from dptse_env.policies import TRANSFERABLE
from dptse_env.schedules import SCHEDULES, make_schedule
from dptse_env.traffic import RecordLibrary
from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """Evaluate query schedules and trained policies."""

    env: str = "dptse_env:dptse/PaperHighway-v0"
    """Environment id."""
    schedules: tuple[str, ...] = tuple(SCHEDULES)
    """Query schedules and oracles; 'all' runs with a bandwidth that covers the road."""
    policies: tuple[str, ...] = ()
    """Trained policies: files, or names of those that come with the package."""
    stochastic: bool = False
    """Whether trained policies draw their actions in place of taking the likeliest."""
    transfer: bool = False
    """Whether trained policies may act on traffic or with a bandwidth that they do not know."""
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
    privacy: str | None = None
    """Privacy preset; the environment's own if not given."""
    epsilon: float | None = None
    """Privacy parameter epsilon; the environment's own if not given."""
    delta: float | None = None
    """Privacy parameter delta; the environment's own if not given."""
    noise_seed: int = 0
    """Seeds noise and estimators; one stream per traffic seed, the same for every schedule."""
    workers: int | None = None
    """Processes that record missing traffic; all cores if not given."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path = Path("results/evaluation")
    """Folder for table, scores and figures."""


def keywords_of(
    args: Args, estimator: str, name: str, saved: Mapping[str, Saved]
) -> dict[str, Any]:
    """Return the keywords of the environment that a schedule or a policy acts in."""
    parameters: str | dict[str, Any] = args.parameters
    if args.parameters.endswith(".json"):
        parameters = dataclasses.asdict(read_parameters(args.parameters))
    keywords: dict[str, Any] = {
        "estimator": estimator,
        "parameters": parameters,
        "traffic_seeds": args.seeds,
        "records": None if args.records is None else str(args.records),
    }
    for key in ("privacy", "epsilon", "delta", "bandwidth"):
        if getattr(args, key) is not None:
            keywords[key] = getattr(args, key)
    if name in saved:
        keywords["action"] = saved[name].action
    if name == "all":
        config: EnvConfig = gym.make(args.env, **keywords).unwrapped.config  # type: ignore[attr-defined]
        keywords["bandwidth"] = config.corridor.n_mainline
    return keywords


def config_of(args: Args) -> EnvConfig:
    """Return the configuration of the first estimator's environment."""
    env = gym.make(args.env, **keywords_of(args, args.estimators[0], args.reference, {}))
    config: EnvConfig = env.unwrapped.config  # type: ignore[attr-defined]
    return config


def make_policy(args: Args, name: str, saved: Mapping[str, Saved], env: Any) -> Policy:
    """Bind a schedule or a policy to an environment, scalar or vector."""
    if name not in saved:
        return make_schedule(name, env, seed=args.noise_seed)
    return saved[name].load(env, allow=TRANSFERABLE if args.transfer else ())


def read_policies(args: Args) -> dict[str, Saved]:
    """Return the policies by the name that tables give them.

    Raises:
        ValueError: A file is no saved policy, or two names are the same.
    """
    saved: dict[str, Saved] = {}
    for source in args.policies:
        path = Path(source)
        # Files of runs are all called the same; their folders are not.
        name = f"{path.parent.name}/{path.stem}" if path.suffix == ".zip" else source
        if name in saved or name in args.schedules:
            raise ValueError(f"policies must have different names, {name!r} is there twice")
        saved[name] = Saved.of(source)
    return saved


def evaluate(args: Args, saved: Mapping[str, Saved]) -> dict[tuple[str, str], list[EpisodeScore]]:
    """Run every schedule and policy with every estimator, on all traffic seeds at once."""
    seeds = parse_seeds(args.seeds)
    # All cells are made before the first runs: bad input shows before anything is recorded.
    cells = {}
    for estimator in args.estimators:
        for name in (*args.schedules, *saved):
            keywords = keywords_of(args, estimator, name, saved)
            env = make_vector(args.env, len(seeds), keywords)
            cells[estimator, name] = env, make_policy(args, name, saved, env)
    corridor = config_of(args).corridor
    library = RecordLibrary(args.records)
    library.ensure(corridor, seeds, workers=args.workers, progress=True)
    scores: dict[tuple[str, str], list[EpisodeScore]] = {}
    with tqdm(
        total=len(cells) * len(seeds), desc="evaluating", unit="episode", mininterval=0.5
    ) as bar:
        for key in list(cells):
            env, policy = cells.pop(key)  # what it has loaded may go once it has run
            scores[key] = run_episodes(
                env,
                policy,
                traffic_seeds=seeds,
                seeds=[args.noise_seed + seed for seed in seeds],
                deterministic=not args.stochastic,
            )
            bar.update(len(seeds))
    return scores


def draw_traffic(args: Args, report: Report, saved: Mapping[str, Saved], noise: str) -> None:
    """Draw what the reference, the best schedule and the best policy make of the first traffic."""
    estimator, seed = args.estimators[0], parse_seeds(args.seeds)[0]
    ranked = [name for name in report.ranked(estimator) if name not in (args.reference, "all")]
    schedules = [name for name in ranked if name not in saved]
    policies = [name for name in ranked if name in saved]
    histories = {}
    for name in (args.reference, *schedules[:1], *policies[:1]):
        env = gym.make(args.env, **keywords_of(args, estimator, name, saved))
        policy = make_policy(args, name, saved, env)
        noise_seed = args.noise_seed + seed
        _, histories[name] = watch_episode(env, policy, traffic_seed=seed, seed=noise_seed)
    title = f"Traffic seed {seed}, {estimator}, {noise}"
    save_space_time(args.output / "space_time.png", histories, title)


def main(args: Args) -> None:
    """Record what is missing, evaluate, and leave table, scores and figures."""
    if args.reference not in args.schedules:
        args = dataclasses.replace(args, schedules=(*args.schedules, args.reference))
    saved = read_policies(args)
    scores = evaluate(args, saved)
    privacy = config_of(args).privacy
    noise = f"{privacy.preset} noise at ({privacy.epsilon:g}, {privacy.delta:g})"
    env_name = args.env.rpartition("/")[2]
    n_episodes = len(parse_seeds(args.seeds))
    title = f"{env_name}, {args.parameters}, {noise}, {n_episodes} held-out episodes"
    report = Report(scores, args.reference, title)
    report.print()
    report.write(args.output, dataclasses.asdict(args))
    report.draw(args.output / "schedules.png")
    draw_traffic(args, report, saved, noise)
    print(f"scores and figures are in {args.output}/")


if __name__ == "__main__":
    run(main, Args, __doc__)
