"""Evaluate query schedules and trained policies on recorded traffic, paired on traffic and noise.

python scripts/evaluate.py --schedules paper round-robin --seeds 2000:2020
python scripts/evaluate.py --policies results/training/primary/pl-0/best.safetensors
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from agents.environments import make_config, parse_env
from agents.figures import RoadMap, draw_maps, estimate_map, save_errors, save_figure
from agents.files import refuse_to_replace
from agents.page import watch, write_page
from agents.play import Cell
from agents.policies import NamedSchedule, find_policy, policy_name
from agents.seeds import seed_kind
from agents.statistics import Interval
from agents.study import ROWS, TABLES, Place, Study, read_rows
from agents.study import run as run_study
from agents.tables import (
    METRICS,
    compared_errors,
    compared_header,
    difference,
    markdown,
    mean,
)
from agents.terminal import make_table, print_table, print_text
from dptse_env.config import EnvConfig, parse_seeds
from dptse_env.schedules import OBSERVATION_SCHEDULES
from dptse_env.utils.fields import require
from scripts.cli import Environment, Machines

ALL = "all"
"""The schedule that runs with a bandwidth that covers the road."""

ERRORS, MAPS, PAGE = "schedules.png", "space_time.png", "page.html"
"""Files of the figures and of the interactive page."""


@dataclass(frozen=True)
class Args(Environment, Machines):
    """Evaluate query schedules and trained policies."""

    schedules: tuple[str, ...] = tuple(OBSERVATION_SCHEDULES)
    """Query schedules and oracles; 'all' runs with a bandwidth that covers the road."""
    policies: tuple[str, ...] = ()
    """Policies: files of saved ones, names of those that come with the package, schedules as
    "module:Class", and models of stable-baselines3 as "module:Class=file.zip", which are unpickled:
    load those that you trust."""
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
    noise_seed: int = 0
    """Seeds noise and estimators; one stream per traffic seed, the same for every schedule."""
    output: Path = Path("results/evaluation")
    """Folder for tables, rows and figures."""
    html: bool = False
    """Write an interactive page, too: page.html, which needs no network."""
    force: bool = False
    """Replace the files of an earlier evaluation in the folder."""
    json: bool = False
    """Print the result as JSON, for a program, in place of a table."""


def make_cell(args: Args, estimator: str, name: str, policy: str) -> Cell:
    """Return the cell of a policy with an estimator.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: An argument is no JSON object or no file of parameters.
    """
    env, keywords = parse_env(args.env)
    keywords["estimator"] = estimator
    if policy == ALL:
        keywords["bandwidth"] = make_config(env, keywords).corridor.n_mainline
    return Cell(
        env=env,
        policy=policy,
        keywords=keywords,
        labels={"estimator": estimator, "policy": name},
        noise_seed=args.noise_seed,
        deterministic=not args.stochastic,
        transferred=args.transfer,
    )


def make_cells(args: Args) -> dict[tuple[str, str], Cell]:
    """Return the cells by estimator and policy.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: A file is no saved policy, or two names are the same.
    """
    policies = {name: name for name in (*args.schedules, args.reference)}
    for source in args.policies:
        name = policy_name(source)
        if name in policies:
            raise ValueError(
                f"schedules and policies must have different names, {name!r} is there twice"
            )
        policies[name] = source
    return {
        key: make_cell(args, *key, policies[key[1]])
        for key in itertools.product(args.estimators, policies)
    }


def reference_config(args: Args) -> EnvConfig:
    """Return the configuration of the reference with the first estimator."""
    cell = make_cell(args, args.estimators[0], args.reference, args.reference)
    return make_config(cell.env, cell.all_keywords)


@dataclass(frozen=True)
class Evaluation:
    """The rows of an evaluation, summarised.

    Attributes:
        title: What was evaluated.
        reference: Policy that the others are compared with.
        policies: Names of all policies.
        rows: An episode each.
    """

    title: str
    reference: str
    estimators: Sequence[str]
    policies: Sequence[str]
    rows: pl.DataFrame

    def mean(self, estimator: str, policy: str, metric: str) -> Interval:
        """Return the mean of an error with its interval."""
        return mean(self.rows, _labels(estimator, policy), metric)

    def ranked(self, estimator: str) -> list[str]:
        """Return the policies by mean density error, best first."""
        return sorted(
            self.policies, key=lambda name: self.mean(estimator, name, "rmse_density").mean
        )

    def print(self) -> None:
        """Print a table for each estimator, best density error first."""
        print_text(f"{self.title}; mean ± half of the 95 % interval")
        against = f"against\n{self.reference}"
        metrics = {name: f"{kind} RMSE\n[{unit}]" for name, (kind, unit) in METRICS.items()}
        columns = [column for metric in metrics.values() for column in (metric, against)]
        for estimator in self.estimators:
            table = make_table(f"estimator {estimator}", "policy", *columns)
            for policy in self.ranked(estimator):
                cells = []
                for metric in METRICS:
                    own = self.mean(estimator, policy, metric)
                    cells.append(f"{own.mean:.2f} ± {own.half_width:.2f}")
                    less = self._difference(estimator, policy, metric)
                    cells.append(
                        "-"
                        if policy == self.reference
                        else f"{less.mean:+.2f} ± {less.half_width:.2f}"
                    )
                table.add_row(policy, *cells)
            print_table(table)

    def markdown(self) -> str:
        """Return the tables as Markdown."""
        parts = [f"# {self.title}"]
        for estimator in self.estimators:
            reference = _labels(estimator, self.reference)
            rows = [
                [name, *compared_errors(self.rows, _labels(estimator, name), reference)]
                for name in self.ranked(estimator)
            ]
            header = ["policy", *compared_header(self.reference)]
            parts += [f"## Estimator `{estimator}`", markdown(header, rows)]
        return "\n\n".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return means and paired differences as plain JSON."""
        return {
            "title": self.title,
            "reference": self.reference,
            "rows": [
                {
                    **_labels(estimator, policy),
                    "mean": {
                        metric: vars(self.mean(estimator, policy, metric))
                        for metric in (*METRICS, "reward")
                    },
                    "difference": {
                        metric: vars(self._difference(estimator, policy, metric))
                        for metric in (*METRICS, "reward")
                    },
                }
                for estimator in self.estimators
                for policy in self.ranked(estimator)
            ],
        }

    def draw(self, path: Path) -> None:
        """Save a figure of density and speed errors of all policies."""
        ranked = self.ranked(self.estimators[0])
        series = {
            name: {
                policy: {metric: self.mean(name, policy, metric) for metric in METRICS}
                for policy in ranked
            }
            for name in self.estimators
        }
        save_errors(path, ranked, series, self.title)

    def _difference(self, estimator: str, policy: str, metric: str) -> Interval:
        reference = _labels(estimator, self.reference)
        return difference(self.rows, _labels(estimator, policy), reference, metric)


def _labels(estimator: str, policy: str) -> dict[str, str]:
    return {"estimator": estimator, "policy": policy}


def shown(found: Evaluation, cells: dict[tuple[str, str], Cell]) -> list[str]:
    """Return the policies to show: the reference, the best schedule and the best policies."""
    estimator = found.estimators[0]
    ranked = [name for name in found.ranked(estimator) if name not in (found.reference, ALL)]
    sources = {name: find_policy(cells[estimator, name].policy) for name in ranked}
    rules = [name for name in ranked if isinstance(sources[name], NamedSchedule)]
    learned = [name for name in ranked if name not in rules]
    return [found.reference, *rules[:1], *learned[:2]]


def draw_traffic(
    args: Args, found: Evaluation, cells: dict[tuple[str, str], Cell], noise: str, place: Place
) -> None:
    """Draw the first traffic seed under some policies, and write the page if it is wanted."""
    estimator, seed = args.estimators[0], parse_seeds(args.seeds)[0]
    episodes = [
        watch(name, cells[estimator, name], seed, place.records) for name in shown(found, cells)
    ]
    history = episodes[0].history
    maps = [RoadMap("true density", history.truth, history)]
    for each in episodes:
        rmse = each.row["rmse_density"]
        maps.append(estimate_map(each.history, rmse, f"{each.name}: estimate"))
        maps.append(RoadMap(f"{each.name}: queried", each.history.queried, each.history))
    title = f"Traffic seed {seed}, {estimator}, {noise}"
    save_figure(draw_maps([maps], width=8.4), args.output / MAPS, title)
    if args.html:
        errors = [
            (
                name,
                {
                    metric: (own.mean, own.half_width)
                    for metric in METRICS
                    for own in [found.mean(estimator, name, metric)]
                },
            )
            for name in found.ranked(estimator)
        ]
        write_page(args.output / PAGE, found.title, errors, episodes, seed)


def main(args: Args) -> None:
    """Record what is missing, evaluate, and write tables, rows and figures."""
    names = (ROWS, TABLES, ERRORS, MAPS, *([PAGE] if args.html else []))
    refuse_to_replace([args.output / name for name in names], args.force)
    cells, seeds = make_cells(args), parse_seeds(args.seeds)
    require(len(seeds) >= 2, "seeds", "at least two, for an interval", args.seeds)
    for cell in cells.values():
        cell.check()
    config = reference_config(args)
    privacy, parameters = config.privacy, config.arz_parameters.name
    noise = f"{privacy.preset} noise at ({privacy.epsilon:g}, {privacy.delta:g})"
    traffic = f"{len(seeds)} episodes on {seed_kind(seeds)} traffic"
    title = f"{parse_env(args.env)[0].rpartition('/')[2]}, {parameters}, {noise}, {traffic}"
    ids = {cell.id for cell in cells.values()}

    def summarise(rows: pl.DataFrame) -> Evaluation:
        policies = list(dict.fromkeys(name for _, name in cells))
        # An interrupted evaluation may have left rows of other cells.
        own = rows.filter(pl.col("cell").is_in(ids))
        return Evaluation(title, args.reference, args.estimators, policies, own)

    study = Study(
        "evaluation",
        tuple(cells.values()),
        seeds,
        lambda rows, folder: summarise(rows).markdown(),
    )
    place = args.place(args.output)
    if args.force and (args.output / ROWS).exists():
        (args.output / ROWS).unlink()
        shutil.rmtree(args.output / "rows", ignore_errors=True)
    run_study(study, place)
    found = summarise(read_rows("evaluation", args.output))
    if args.json:
        print(json.dumps(found.to_dict(), indent=2))
    else:
        found.print()
    found.draw(args.output / ERRORS)
    draw_traffic(args, found, cells, noise, place)
    if not args.json:
        page = f"; a browser opens {args.output / PAGE}" if args.html else ""
        print(f"tables and figures are in {args.output}/{page}")
