r"""Compare query schedules and policies on the same traffic and noise.

dptse evaluate --env dptse_env:dptse/ShortHighway-v0 --seeds 2000:2004 \
    --schedules shift-ahead round-robin

The error is minus 1,000 times the reward. Differences are paired by traffic and noise.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import polars as pl

from agents.environments import make_config, parse_env
from agents.figures import RoadMap, draw_bars, draw_errors, draw_maps, estimate_map, save_figure
from agents.page import watch, write_page
from agents.play import Cell
from agents.policies import NamedSchedule, find_policy, policy_name
from agents.seeds import seed_kind
from agents.statistics import Interval
from agents.study import OWN, PARTS, ROWS, TABLES, Study, read_rows
from agents.study import run as run_study
from agents.tables import (
    DENSITY,
    ERROR,
    SPEED,
    below,
    difference,
    error_label,
    markdown,
    mean,
    values,
)
from agents.terminal import make_table, print_table, print_text
from dptse_env.config import parse_seeds
from dptse_env.policies import DETERMINISTIC
from dptse_env.privacy import rounded_up
from dptse_env.schedules import OBSERVATION_SCHEDULES, ORACLES
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import require
from scripts.cli import Environment, Machines

ALL = "all"
"""The schedule that runs with a bandwidth that covers the road."""

METRICS = (ERROR, DENSITY, SPEED)
ERRORS, MAPS, PAGE = "schedules.png", "space_time.png", "page.html"
"""Files of the figures and of the interactive page."""


@dataclass(frozen=True)
class Args(Machines, Environment):
    """Evaluate query schedules and policies."""

    schedules: tuple[str, ...] = tuple(OBSERVATION_SCHEDULES)
    """Schedules and oracles; 'all' has a bandwidth that covers the road."""
    policies: tuple[str, ...] = ()
    """Saved policies by file or shipped name, or "module:Class"; dptse policy import converts
    models of stable-baselines3."""
    acts: Literal["deterministic", "drawn"] | None = None
    """Let policies take their likeliest actions or draw them; as their cards say if not given."""
    transfer: bool = False
    """Let policies act where they were not trained."""
    estimators: tuple[str, ...] = ()
    """State estimators; the environment's own if none is given."""
    seeds: str = "2000:2008"
    """Traffic seeds, first:stop, that nothing was trained on."""
    reference: str = "round-robin"
    """Schedule that the others are compared with."""
    noise_seed: int = 0
    """Seeds noise and estimators, one stream for each traffic seed."""
    output: Path = Path("results/evaluation")
    """Folder for tables, rows and figures."""
    html: bool = False
    """Also write an interactive page, page.html."""
    force: bool = False
    """Replace the files of an earlier evaluation."""
    json: bool = False
    """Print JSON, for a program, in place of tables."""


@dataclass(frozen=True)
class Score:
    """The errors of a policy with an estimator.

    Attributes:
        means: By error.
        differences: To the reference, paired by traffic and noise.
    """

    policy: str
    means: Mapping[str, Interval]
    differences: Mapping[str, Interval]


Scores = Mapping[str, Sequence[Score]]
"""By estimator; the policy of the least error comes first."""


def make_cells(args: Args) -> list[Cell]:
    """Return a cell for each estimator and policy.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: A keyword is out of range, or two policies have one name.
    """
    env, given = parse_env(args.env)
    if args.estimators:  # the environment's own may refuse its road
        given["estimator"] = args.estimators[0]
    config = make_config(env, given)
    policies = {name: name for name in (*args.schedules, args.reference)}
    for source in args.policies:
        name = policy_name(source)
        require(name not in policies, "policies", "of different names", name)
        policies[name] = source
    cells = []
    for estimator in args.estimators or (str(config.estimator),):
        own = {**given, "estimator": estimator} if args.estimators else given
        for name, policy in policies.items():
            more = {"bandwidth": config.corridor.geometry.n_mainline} if policy == ALL else {}
            cells.append(
                Cell(
                    env,
                    policy,
                    {**own, **more},
                    labels={"estimator": estimator, "policy": name},
                    noise_seed=args.noise_seed,
                    deterministic=None if args.acts is None else args.acts == DETERMINISTIC,
                    transferred=args.transfer,
                )
            )
    return cells


def score(rows: pl.DataFrame, cells: Sequence[Cell], reference: str) -> Scores:
    """Return the scores of cells; an interval of one episode is its point, with ``n`` 1."""
    is_one = rows["traffic_seed"].n_unique() == 1

    def compare(own: Mapping[str, str], against: Mapping[str, str], metric: str) -> Interval:
        if not is_one:
            return difference(rows, own, against, metric)
        return point(values(rows, own, metric) - values(rows, against, metric))

    scores: dict[str, list[Score]] = {}
    for cell in cells:
        own, against = cell.labels, {**cell.labels, "policy": reference}
        means = {
            each: point(values(rows, own, each)) if is_one else mean(rows, own, each)
            for each in METRICS
        }
        differences = {each: compare(own, against, each) for each in METRICS}
        found = scores.setdefault(own["estimator"], [])
        found.append(Score(own["policy"], means, differences))
    return {name: sorted(own, key=lambda s: s.means[ERROR].mean) for name, own in scores.items()}


def point(values: FloatArray) -> Interval:
    """Return a single value as an interval without length."""
    (value,) = values.tolist()
    return Interval(value, value, value, 1)


def as_json(score: Score) -> dict[str, Any]:
    """Return a score as plain JSON; ends of an interval are null where it has none."""
    content = dataclasses.asdict(score)
    for interval in (*content["means"].values(), *content["differences"].values()):
        if interval["n"] == 1:
            interval |= {"low": None, "high": None}
    return content


def in_words(interval: Interval, sign: str = "") -> str:
    """Return a mean and half of its interval, if it has one."""
    text = f"{interval.mean:{sign}.2f}"
    return text if interval.n == 1 else f"{text} ± {interval.half_width:.2f}"


def make_rows(scores: Sequence[Score], reference: str) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of an estimator."""
    header, rows = ["policy"], [[each.policy] for each in scores]
    for metric in METRICS:
        header += [error_label(metric), f"against {reference}"]
        for row, each in zip(rows, scores, strict=True):
            own, less = each.means[metric], each.differences[metric]
            row.append(in_words(own))
            row.append("-" if each.policy == reference else in_words(less, "+"))
    return header, rows


def legend(scores: Scores) -> str:
    """Return what the numbers of the tables are."""
    n = next(iter(scores.values()))[0].means[ERROR].n
    several = "mean ± half of the 95 % interval"
    return several if n > 1 else "one episode has no interval: differences may be chance"


def write_markdown(title: str, scores: Scores, reference: str) -> str:
    """Return the tables as Markdown."""
    parts = [f"# {title}", f"{legend(scores).capitalize()}."]
    for estimator, own in scores.items():
        parts += [f"## Estimator `{estimator}`", markdown(*make_rows(own, reference))]
    return "\n\n".join(parts)


def print_scores(title: str, scores: Scores, reference: str) -> None:
    """Print a table for each estimator."""
    print_text(f"{title}; {legend(scores)}")
    for estimator, own in scores.items():
        header, rows = make_rows(own, reference)
        folded = [each.replace(" [", "\n[").replace("against ", "against\n") for each in header]
        table = make_table(f"estimator {estimator}", *folded)
        for row in rows:
            table.add_row(*row)
        print_table(table)


def verdict(rows: pl.DataFrame, own: Sequence[Score], cells: Sequence[Cell]) -> str:
    """Return how the best learned policy stands to the best rule, in a line; empty without one.

    Args:
        rows: Of the evaluation.
        own: Scores with an estimator, the least error first.
        cells: Of that estimator.
    """
    known = {cell.labels["policy"]: cell for cell in cells}
    is_rule = {n: isinstance(find_policy(c.policy), NamedSchedule) for n, c in known.items()}
    ranked = [each for each in own if each.policy != ALL and each.policy not in ORACLES]
    learned = next((each for each in ranked if not is_rule[each.policy]), None)
    rule = next((each for each in ranked if is_rule[each.policy]), None)
    if learned is None or rule is None or learned.means[ERROR].n == 1:
        return ""
    gain = below(rows, known[learned.policy].labels, known[rule.policy].labels)
    low, mean, high = gain.low, gain.mean, gain.high
    side = "below"
    if mean < 0.0:
        low, mean, high, side = -high, -mean, -low, "above"
    return (
        f"learned ({learned.policy}) {learned.means[ERROR].mean:.1f}, "
        f"best rule ({rule.policy}) {rule.means[ERROR].mean:.1f}: {mean:.1f} % {side}, "
        f"95 % interval {low:.1f} to {high:.1f}, paired by traffic and noise"
    )


def draw_traffic(args: Args, title: str, scores: Scores, cells: Sequence[Cell]) -> None:
    """Draw the first traffic seed under some policies, and write the page if it is wanted.

    They are the reference, the best schedule and the best two policies.
    """
    estimator, own = next(iter(scores.items()))
    known = {cell.labels["policy"]: cell for cell in cells if cell.labels["estimator"] == estimator}
    ranked = [each.policy for each in own if each.policy not in (args.reference, ALL)]
    rules = [n for n in ranked if isinstance(find_policy(known[n].policy), NamedSchedule)]
    learned = [name for name in ranked if name not in rules]
    seed, records = parse_seeds(args.seeds)[0], args.records
    episodes = [
        watch(name, known[name], seed, records)
        for name in (args.reference, *rules[:1], *learned[:2])
    ]
    history = episodes[0].history
    maps = [RoadMap("true density", history.truth, history)]
    for each in episodes:
        maps.append(estimate_map(each.history, each.row[DENSITY], f"{each.name}: estimate"))
        maps.append(RoadMap(f"{each.name}: queried", each.history.queried, each.history))
    figure = draw_maps([maps], width=8.4)
    save_figure(figure, args.output / MAPS, f"{title}: seed {seed}, {estimator}")
    if args.html:
        errors = [
            (each.policy, {m: (v.mean, v.half_width) for m, v in each.means.items()})
            for each in own
        ]
        write_page(args.output / PAGE, title, errors, episodes, seed)


def make_title(cell: Cell, seeds: Sequence[int]) -> str:
    """Return what is evaluated, in words, given one of the cells."""
    config = make_config(cell.env, cell.keywords)
    model = f"parameters {config.parameters.name}, release model {config.privacy.preset}"
    epsilon, delta = config.privacy.epsilon, config.privacy.delta
    privacy = f"epsilon {rounded_up(epsilon)}, delta {rounded_up(delta)}"
    traffic = f"{len(seeds)} episode{'s' * (len(seeds) > 1)} on {seed_kind(seeds)} traffic"
    return f"{cell.env.rpartition('/')[2]}, {model} ({privacy}), {traffic}"


def main(args: Args) -> None:
    """Record what is missing, evaluate, and write tables, rows and figures."""
    cells, seeds = make_cells(args), parse_seeds(args.seeds)
    for cell in cells:
        cell.check()
    # The tables are written last: without them an evaluation goes on.
    require_output(args.output, [TABLES], force=args.force)
    figures = (ERRORS, MAPS, *([PAGE] if args.html else []))
    require_output(args.output, figures, own=OWN, force=args.force)
    title, ids = make_title(cells[0], seeds), {cell.id for cell in cells}

    def report(rows: pl.DataFrame, folder: Path) -> str:
        # An interrupted evaluation may have left rows of other cells.
        scores = score(rows.filter(pl.col("cell").is_in(ids)), cells, args.reference)
        series = {
            name: {
                each.policy: {error_label(metric): mean for metric, mean in each.means.items()}
                for each in own
            }
            for name, own in scores.items()
        }
        first, *others = series.values()
        names = {cell.labels["policy"]: cell.policy for cell in cells}
        learned = [n for n in first if not isinstance(find_policy(names[n]), NamedSchedule)]
        figure = draw_errors(list(first), series) if others else draw_bars(first, learned)
        save_figure(figure, folder / ERRORS, title)
        draw_traffic(args, title, scores, cells)
        return write_markdown(title, scores, args.reference)

    place = args.place(args.output)
    if args.force:
        for name in (ROWS, TABLES, *figures):
            (args.output / name).unlink(missing_ok=True)
        shutil.rmtree(args.output / PARTS, ignore_errors=True)
    run_study(Study("evaluation", tuple(cells), seeds, report), place)
    rows = read_rows("evaluation", args.output).filter(pl.col("cell").is_in(ids))
    scores = score(rows, cells, args.reference)
    if args.json:
        played = [
            {"estimator": estimator, **as_json(each)}
            for estimator, own in scores.items()
            for each in own
        ]
        found = {"title": title, "reference": args.reference, "rows": played}
        print(json.dumps(found, indent=2))
        return
    print_scores(title, scores, args.reference)
    for estimator, own in scores.items():
        said = verdict(rows, own, [c for c in cells if c.labels["estimator"] == estimator])
        if said:
            print(said)
    page = f", {PAGE} (for a browser)" if args.html else ""
    print(f"wrote {args.output}/: {TABLES}, {ERRORS} (errors), {MAPS} (queries){page}")
