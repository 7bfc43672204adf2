"""Evaluate query schedules and trained policies on recorded traffic, paired on traffic and noise.

python scripts/evaluate.py --schedules paper round-robin --seeds 2000:2020
python scripts/evaluate.py --policies results/training/primary/pl-0/best.zip
python scripts/evaluate.py --suite query-suite-v2 --policies round-robin my_package:MySchedule
python scripts/evaluate.py --suite query-suite-v2 --verify results/suites/query-suite-v2/mine.json
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from agents.engines.engine import run_in_order
from agents.environments import make_config, unwrap
from agents.evaluation.episodes import EpisodeScore, run_episode, seed_kind, watch_episode
from agents.evaluation.ladder import Rung, run_rung
from agents.evaluation.page import write_page
from agents.evaluation.report import EPISODES, SUMMARY, Report
from agents.evaluation.watched import Watched
from agents.figures import (
    RoadMap,
    draw_maps,
    estimate_map,
    save_figure,
)
from agents.files import refuse_to_replace
from agents.policies import NamedSchedule, PolicySource, find_policy
from dptse_env.config import EnvConfig, parse_seeds
from dptse_env.rendering import History
from dptse_env.schedules import OBSERVATION_SCHEDULES
from dptse_env.traffic import Records, is_road_file
from dptse_env.utils.validation import require
from scripts.cli import NOT_RESULTS, Road, records_argument, run
from scripts.evaluate_suite import evaluate_suite

ALL = "all"
"""The schedule that runs with a bandwidth that covers the road."""

ERRORS, MAPS, PAGE = "schedules.png", "space_time.png", "page.html"
"""Files of the figures and of the page to look at."""


@dataclass(frozen=True)
class Args(Road):
    """Evaluate query schedules and trained policies."""

    schedules: tuple[str, ...] = tuple(OBSERVATION_SCHEDULES)
    """Query schedules and oracles; 'all' runs with a bandwidth that covers the road."""
    policies: tuple[str, ...] = ()
    """Policies: files of saved ones, names of those that come with the package, schedules as
    "module:Class", and models of stable-baselines3 as "module:Class=file.zip", which are unpickled:
    load those that you trust."""
    suite: str | None = None
    """Score the policies in the cells of a suite, such as query-suite-v2, which say everything but
    the policies, machines and output."""
    verify: Path | None = None
    """Card of a suite of which a drawn cell is run again, to see whether its errors are right."""
    stochastic: bool = False
    """Let trained policies draw their actions instead of taking the likeliest."""
    transfer: bool = False
    """Let trained policies act on traffic or with a bandwidth that they were not trained for."""
    estimators: tuple[str, ...] = ("ekf", "random_walk")
    """State estimators."""
    seeds: str = "2000:2008"
    """Traffic seeds, first:stop; keep them apart from those used to train or calibrate."""
    reference: str = "paper"
    """Schedule that the others are compared with; added if not among them."""
    bandwidth: int | None = None
    """Most segments to query a second; the environment's own if not given."""
    parameters: str | None = None
    """ARZ parameters: the name of a set, or a JSON file as scripts/calibrate.py writes it; if not
    given those of the keywords or of the road file, and else w99-3lane."""
    privacy: str | None = None
    """Privacy preset; the environment's own if not given."""
    epsilon: float | None = None
    """Privacy parameter epsilon; the environment's own if not given."""
    delta: float | None = None
    """Privacy parameter delta; the environment's own if not given."""
    noise_seed: int = 0
    """Seeds noise and estimators; one stream per traffic seed, the same for every schedule."""
    output: Path = Path("results/evaluation")
    """Folder for table, scores and figures."""
    html: bool = False
    """Leave a page to look at, too: page.html, interactive, which needs no network."""
    force: bool = False
    """Replace the files of an earlier evaluation in the folder."""
    json: bool = False
    """Print the result as JSON, for a program, in place of a table."""


def make_keywords(
    args: Args, estimator: str, source: PolicySource, records: Records = None
) -> dict[str, Any]:
    """Return the keywords of the environment in which a policy acts.

    Raises:
        ValueError: An argument is no JSON object or no file of parameters.
    """
    keywords: dict[str, Any] = {
        **args.given_keywords(),
        **source.keywords,
        "estimator": estimator,
        "traffic_seeds": args.seeds,
        "records": records_argument(args.records) if records is None else records,
    }
    for key in ("privacy", "epsilon", "delta", "bandwidth", "parameters"):
        if getattr(args, key) is not None:
            keywords[key] = getattr(args, key)
    if not is_road_file(keywords.get("corridor")):
        keywords.setdefault("parameters", "w99-3lane")
    if source.source == ALL:
        keywords["bandwidth"] = make_config(args.env, keywords).corridor.n_mainline
    return keywords


def reference_config(args: Args) -> EnvConfig:
    """Return the configuration of the reference with the first estimator."""
    keywords = make_keywords(args, args.estimators[0], find_policy(args.reference))
    return make_config(args.env, keywords)


def find_sources(args: Args) -> dict[str, PolicySource]:
    """Return schedules and policies by their names in tables.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: A file is no saved policy, or two names are the same.
    """
    sources = {name: find_policy(name) for name in (*args.schedules, args.reference)}
    for source in args.policies:
        path = Path(source)
        # Files of runs have one name; their folders differ.
        name = f"{path.parent.name}/{path.stem}" if path.suffix == ".zip" else source
        if name in sources:
            raise ValueError(
                f"schedules and policies must have different names, {name!r} is there twice"
            )
        sources[name] = find_policy(source)
    return sources


def evaluate(
    args: Args, sources: Mapping[str, PolicySource]
) -> dict[tuple[str, str], list[EpisodeScore]]:
    """Run every schedule and policy with every estimator, on all traffic seeds at once."""
    seeds, keys = parse_seeds(args.seeds), list(itertools.product(args.estimators, sources))
    # All are made before the first runs: bad input shows before anything is recorded.
    for estimator, name in keys:
        make_rung(args, estimator, name, sources[name]).make()
    place = args.workplace(args.output)
    place.record(reference_config(args).corridor, seeds)
    rungs = [make_rung(args, *key, sources[key[1]], place.records, place.threads) for key in keys]
    scores = run_in_order(
        place.engine,
        run_rung,
        rungs,
        size=lambda rung: len(rung.seeds),
        desc="evaluating",
        unit="episode",
        mininterval=0.5,
    )
    return dict(zip(keys, scores, strict=True))


def make_rung(
    args: Args,
    estimator: str,
    name: str,
    source: PolicySource,
    records: Records = None,
    threads: int | None = None,
) -> Rung:
    """Return the task of a policy with an estimator.

    Raises:
        ValueError: An argument is no JSON object or no file of parameters.
    """
    return Rung(
        key=(estimator, name),
        source=source,
        env=args.env,
        keywords={**make_keywords(args, estimator, source, records), "threads": threads},
        seeds=parse_seeds(args.seeds),
        noise_seed=args.noise_seed,
        deterministic=not args.stochastic,
        transferred=args.transfer,
    )


def draw_traffic(
    args: Args, report: Report, sources: Mapping[str, PolicySource], noise: str
) -> None:
    """Draw the first traffic with the reference, the best schedule and the best policy."""
    estimator, seed = args.estimators[0], parse_seeds(args.seeds)[0]
    ranked = [name for name in report.ranked(estimator) if name not in (args.reference, ALL)]
    learned = [name for name in ranked if not isinstance(sources[name], NamedSchedule)]
    schedules = [name for name in ranked if name not in learned]
    maps: list[RoadMap] = []
    for name in (args.reference, *schedules[:1], *learned[:1]):
        env = gym.make(args.env, **make_keywords(args, estimator, sources[name]))
        policy = make_rung(args, estimator, name, sources[name]).load(env)
        score, history = watch_episode(env, policy, traffic_seed=seed, seed=args.noise_seed + seed)
        maps += [
            *([] if maps else [RoadMap("true density", history.truth, history)]),
            estimate_map(history, score.rmse_density, f"{name}: estimate"),
            RoadMap(f"{name}: queried", history.queried, history),
        ]
    title = f"Traffic seed {seed}, {estimator}, {noise}"
    save_figure(draw_maps([maps], width=8.4), args.output / MAPS, title)


def shown(args: Args, report: Report, sources: Mapping[str, PolicySource]) -> list[str]:
    """Return the policies to show: the reference, the best schedule and the best policies."""
    ranked = [name for name in report.ranked(args.estimators[0]) if name != ALL]
    rules = [name for name in ranked if isinstance(sources[name], NamedSchedule)]
    learned = [name for name in ranked if name not in rules]
    best = [name for name in rules if name != args.reference]
    return [args.reference, *best[:1], *learned[:2]]


def watch(args: Args, name: str, source: PolicySource) -> Watched:
    """Run the first episode of a policy with the first estimator, and keep what happens."""
    rung, seed = make_rung(args, args.estimators[0], name, source), parse_seeds(args.seeds)[0]
    keywords = {key: value for key, value in rung.keywords.items() if key != "threads"}
    env = gym.make(args.env, **keywords)
    process = unwrap(env).process
    watched = Watched(name, process.config.corridor, seed, History.empty(process))
    run_episode(
        env,
        rung.load(env),
        traffic_seed=seed,
        seed=args.noise_seed + seed,
        on_second=lambda: watched.append(process),
    )
    return watched


def suite_options(args: Args) -> tuple[str, Path]:
    """Return the suite, and the folder of its cards.

    Raises:
        ValueError: There is an argument that the suite says, or a card to verify and no suite.
    """
    if args.suite is None:
        raise ValueError("verify needs the suite of the card, such as --suite query-suite-v2")
    own = {"suite", "policies", "verify", *NOT_RESULTS} - {"force"}
    given = [
        each.name
        for each in dataclasses.fields(args)
        if each.name not in own and getattr(args, each.name) != each.default
    ]
    if given:
        raise ValueError(f"{given[0]} has no use with a suite, whose cells say all: leave it out")
    is_default = args.output == Args.output
    return args.suite, Path("results/suites") / args.suite if is_default else args.output


def written(args: Args) -> list[Path]:
    """Return the files that an evaluation writes."""
    names = (EPISODES, SUMMARY, ERRORS, MAPS, *([PAGE] if args.html else []))
    return [args.output / name for name in names]


def main(args: Args) -> None:
    """Record what is missing, evaluate, and leave table, scores and figures."""
    if args.suite is not None or args.verify is not None:
        suite, folder = suite_options(args)
        evaluate_suite(suite, args.policies, args.verify, folder, args, args.json)
        return
    refuse_to_replace(written(args), args.force)
    sources = find_sources(args)
    require(len(parse_seeds(args.seeds)) >= 2, "seeds", "at least two, for an interval", args.seeds)
    scores = evaluate(args, sources)
    seeds, config = parse_seeds(args.seeds), reference_config(args)
    privacy, parameters = config.privacy, config.arz_parameters.name
    noise = f"{privacy.preset} noise at ({privacy.epsilon:g}, {privacy.delta:g})"
    traffic = f"{len(seeds)} episodes on {seed_kind(seeds)} traffic"
    title = f"{args.env.rpartition('/')[2]}, {parameters}, {noise}, {traffic}"
    report = Report(scores, args.reference, title)
    report.write(args.output, dataclasses.asdict(args))
    if args.json:
        print((args.output / SUMMARY).read_text(encoding="utf-8"), end="")
    else:
        report.print()
    report.draw(args.output / ERRORS)
    draw_traffic(args, report, sources, noise)
    if args.html:
        episodes = [watch(args, name, sources[name]) for name in shown(args, report, sources)]
        write_page(args.output / PAGE, report, episodes)
    if not args.json:
        page = f"; a browser opens {args.output / PAGE}" if args.html else ""
        print(f"scores and figures are in {args.output}/{page}")


if __name__ == "__main__":
    run(main, Args, __doc__)
