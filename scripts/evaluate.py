r"""Compare query policies and estimators on the same traffic and noise.

dptse evaluate --env dptse_env:dptse/ShortHighway-v0 --test-seeds 2000:2004 \
    --policies shift-ahead round-robin

dptse evaluate --suite short-printed --policies speed-front

Errors leave out the first 60 s. Differences are paired by traffic and noise. An entry to the suite
gets a card. Several policies are training seeds; TOML names tasks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl

from agents.environments import heading, make_config, parse_env, settings_of
from agents.figures import RoadMap, draw_errors, draw_maps, estimate_map, save_figure
from agents.page import watch, write_page
from agents.play import Cell
from agents.policies import find_policy, policy_name
from agents.seeds import seed_kind
from agents.statistics import Interval, mean_interval
from agents.studies import suite
from agents.studies.suite import tasks as suite_tasks
from agents.studies.suite.entries import CARD, begin, check, make_entry
from agents.studies.suite.tasks import NAME, ROUND_ROBIN
from agents.study import OWN, ROWS, TABLES, Place, Study, play_study, remove_parts, write_tables
from agents.tables import (
    DENSITY,
    ERROR,
    HONESTY,
    SPEED,
    UnmeasuredError,
    are_present,
    below,
    error_label,
    markdown,
    values,
)
from agents.terminal import make_table
from dptse_env.config import MOST_SEEDS, parse_seeds
from dptse_env.evaluation import WARM_UP
from dptse_env.policies import DETERMINISTIC
from dptse_env.schedules import OBSERVATION_SCHEDULES, ORACLES
from dptse_env.traffic import Recordings
from dptse_env.traffic.imported import has_vehicles
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import integer, read_json, require, require_name
from scripts.cli import (
    Command,
    Environment,
    Estimators,
    Machines,
    Policies,
    Replacing,
    Seed,
    TestSeeds,
    require_open,
)

ALL = "all"
"""The schedule that runs with a bandwidth that covers the road."""

METRICS = (ERROR, DENSITY, SPEED)
ERRORS, MAPS, PAGE = "errors.png", "space_time.png", "page.html"
"""Files of the figures and of the interactive page."""
OUTPUT = Path("results/evaluation")


@dataclass(frozen=True, kw_only=True)
class Args(
    Machines, Replacing, Seed, TestSeeds, Estimators, Policies, Environment, Command
):  # fmt: skip
    """Compare query policies and estimators."""

    policies: tuple[str, ...] = ()
    """Policies by name, file or "module:Class"; all rules if none."""
    estimators: tuple[str, ...] = ()
    """Estimators by name or "module:Class"; the environment's own if none."""
    test_seeds: str = "2000:2008"
    """Traffic seeds, first:stop; validation begins at 1000."""
    seed: int = 0
    """Seeds noise and estimators, one stream for each traffic seed."""
    reference: str | None = None
    """Policy to compare with; round-robin beside other policies."""
    acts: Literal["deterministic", "drawn"] | None = None
    """Take likeliest actions, or draw them; else as policies say."""
    transfer: bool = False
    """Let policies act where they were not trained."""
    html: bool = False
    """Also write an interactive page, page.html."""
    suite: tuple[str, ...] | None = None
    """Play tasks of the query suite; all if none is named."""
    fresh: int | None = None
    """Play so many traffic seeds that are drawn at this call."""
    beside: tuple[Path, ...] = ()
    """Cards of other entries to the suite."""
    replay: int | None = None
    """First play so many training seeds of these cards again."""
    output: Path = OUTPUT
    """Folder of the results; results/my-suite/NAME for an entry to the suite."""


def main(args: Args) -> None:
    """Compare policies, or let them enter the suite."""
    if args.suite is None:
        args.require_unset("without --suite", "fresh", "beside", "replay")
        compare(args)
    else:
        rest = "env", "estimators", "test_seeds", "seed", "reference", "acts", "transfer", "html"
        args.require_unset("with --suite", *rest, "force")
        enter(args, args.suite or tuple(suite_tasks.TASKS))


def play(name: str, cells: tuple[Cell, ...], seeds: tuple[int, ...], place: Place) -> pl.DataFrame:
    """Return the rows of cells on some traffic; a folder may have others, of earlier runs."""
    study = Study(name, cells, seeds, lambda rows, folder: "")
    rows = play_study(study, place)
    asked = {(cell.id, seed) for cell in cells for seed in study.seeds_of(cell)}
    keys = ("cell", "traffic_seed")
    wanted = pl.DataFrame(sorted(asked), schema=keys, orient="row")
    return rows.filter(are_present(rows)).join(wanted, on=keys, how="semi", maintain_order="left")


# Comparisons.


@dataclass(frozen=True)
class Score:
    """The errors of a policy with an estimator; an interval of one episode is its point.

    Attributes:
        means: By error, and of the squared errors over their reported variances.
        differences: By error, to the reference with this estimator, paired by traffic and noise.
        least: Estimator with which this policy errs least.
        estimator_differences: By error, to this policy with that estimator.
    """

    estimator: str
    policy: str
    means: Mapping[str, Interval]
    differences: Mapping[str, Interval]
    least: str
    estimator_differences: Mapping[str, Interval]

    @property
    def error(self) -> float:
        """The mean error."""
        return self.means[ERROR].mean


def find_reference(args: Args) -> str:
    """Return the policy that the others are compared with."""
    if args.reference is not None:
        return args.reference
    is_alone = len(args.policies) == 1 and len({*args.estimators}) > 1
    return args.policies[0] if is_alone else ROUND_ROBIN


def compare(args: Args) -> None:
    """Record what is missing, evaluate, and write tables, rows and figures."""
    title, cells = make_cells(args)
    reference = policy_name(find_reference(args))
    seeds = parse_seeds(args.test_seeds, "test_seeds")
    integer("seed", args.seed, 0)
    title += f", {len(seeds)} episode{'s' * (len(seeds) > 1)} on {seed_kind(seeds)} traffic"
    title += f" from second {WARM_UP + 1} on"
    title += f", seed {args.seed}" if args.seed else ""
    title += f", actions {args.acts}" if args.acts else ""
    for cell in cells:
        cell.check()
    # The tables are written last: without them an evaluation goes on.
    require_output(args.output, [TABLES], force=args.force)
    figures = (ERRORS, MAPS, *([PAGE] if args.html else []))
    require_output(args.output, figures, own=OWN, force=args.force)

    place = args.place(args.output)
    if args.force:
        for name in (ROWS, TABLES, *figures):
            (args.output / name).unlink(missing_ok=True)
        remove_parts(args.output)
    rows = play("evaluation", cells, seeds, place)
    scores = score(rows, cells, reference)
    draw_scores(args.output / ERRORS, title, scores, cells)
    shown = draw_traffic(args, title, scores, cells)
    header, lines = make_rows(scores, reference)
    table = markdown([each.replace("\n", " ") for each in header], lines)
    of_estimator = {each.labels["estimator"]: each for each in cells}
    settings = {
        name: settings_of(each.env, each.all_keywords) for name, each in of_estimator.items()
    }
    notes = f"{legend(scores)}. Settings {in_force(settings)}"
    notes += not_published(cells[0].config.corridor.recordings)
    write_tables(args.output, f"# {title}\n\n{notes}.\n\n{table}", rows)
    page = f", {PAGE} (for a browser)" if args.html else ""
    args.answer(
        {
            "title": title, "settings": settings, "reference": reference,
            "rows": [as_json(each) for each in scores],
        },
        f"{title}\n{notes}", make_table("", *header, left=2, rows=lines),
        *policy_verdicts(rows, scores, cells), *estimator_verdicts(scores),
        f"wrote {args.output}/: {TABLES}, {ERRORS} (errors), {MAPS} ({shown}){page}",
    )  # fmt: skip


def make_cells(args: Args) -> tuple[str, tuple[Cell, ...]]:
    """Return the environment in words, and a cell for each estimator and policy.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: A keyword is out of range, or two policies have one name.
    """
    env, given = parse_env(args.env)
    require_open(given)
    if args.estimators:  # the environment's own may refuse its road
        given["estimator"] = args.estimators[0]
    config = make_config(env, given)
    policies: dict[str, str] = {}
    for source in (*(args.policies or OBSERVATION_SCHEDULES), find_reference(args)):
        name = policy_name(source)
        require(policies.setdefault(name, source) == source, "policies", "of different names", name)
    cells = []
    for estimator in dict.fromkeys(args.estimators or (str(config.estimator),)):
        own = {**given, "estimator": estimator} if args.estimators else given
        make_config(env, own)  # warns where its settings are not of this road
        for name, policy in policies.items():
            more = {"bandwidth": config.corridor.geometry.n_mainline} if policy == ALL else {}
            cells.append(
                Cell(
                    env,
                    policy,
                    {**own, **more},
                    labels={"estimator": estimator, "policy": name},
                    noise_seed=args.seed,
                    deterministic=None if args.acts is None else args.acts == DETERMINISTIC,
                    transferred=args.transfer,
                    watchers=("honesty",),
                )
            )
    return heading(env, given), tuple(cells)


def score(rows: pl.DataFrame, cells: Sequence[Cell], reference: str) -> list[Score]:
    """Return the scores of cells, by estimator; the least errors come first."""
    names = [(str(cell.labels["estimator"]), str(cell.labels["policy"])) for cell in cells]
    found = {
        name: {each: values(rows, cell.labels, each) for each in (*METRICS, *HONESTY)}
        for name, cell in zip(names, cells, strict=True)
    }
    worst_first = sorted(names, key=lambda name: -found[name][ERROR].mean())
    least = {policy: estimator for estimator, policy in worst_first}

    def differences(name: tuple[str, str], other: tuple[str, str]) -> dict[str, Interval]:
        return {each: _interval(found[name][each] - found[other][each]) for each in METRICS}

    scores = [
        Score(
            estimator,
            policy,
            {each: _interval(own) for each, own in found[estimator, policy].items()},
            differences((estimator, policy), (estimator, reference)),
            least[policy],
            differences((estimator, policy), (least[policy], policy)),
        )
        for estimator, policy in names
    ]
    scores.sort(key=lambda each: each.error)
    best = list(dict.fromkeys(each.estimator for each in scores))
    return sorted(scores, key=lambda each: best.index(each.estimator))


def _interval(values: FloatArray) -> Interval:
    """Return the mean of values with its interval, of length 0 where there is none."""
    if len(values) > 1 and np.isfinite(values).all():
        return mean_interval(values)
    mean = float(values.mean())
    return Interval(mean, mean, mean, 1)


def as_json(score: Score) -> dict[str, Any]:
    """Return a score as plain JSON; null stands for ends of an interval that it has not."""
    content = dataclasses.asdict(score)
    for intervals in (each for each in content.values() if isinstance(each, dict)):
        for interval in intervals.values():
            if interval["n"] == 1:
                interval |= {"low": None, "high": None}
            if not np.isfinite(interval["mean"]):
                interval["mean"] = None
    return content


def in_words(interval: Interval, sign: str = "") -> str:
    """Return a mean and half of its interval, if it has one."""
    text = f"{interval.mean:{sign}.2f}"
    return text if interval.n == 1 else f"{text} ± {interval.half_width:.2f}"


def make_rows(scores: Sequence[Score], reference: str) -> tuple[list[str], list[list[str]]]:
    """Return header, folded, and rows of the table.

    Policies are compared with the reference; a single one is, between estimators.
    """
    header, rows = ["estimator", "policy"], [[each.estimator, each.policy] for each in scores]
    if len({each.policy for each in scores}) > 1:
        other, own = reference, [(each.policy, each.differences) for each in scores]
    else:
        other = scores[0].estimator
        own = [(each.estimator, each.estimator_differences) for each in scores]
    for metric in METRICS:
        header.append(error_label(metric).replace(" [", "\n["))
        for row, each in zip(rows, scores, strict=True):
            row.append(in_words(each.means[metric]))
        if len(scores) > 1:
            header.append(f"against\n{other}")
            for row, (name, differences) in zip(rows, own, strict=True):
                row.append("-" if name == other else in_words(differences[metric], "+"))
    header.append("chi2 density,\nspeed")
    for row, each in zip(rows, scores, strict=True):
        row.append(", ".join(f"{each.means[name].mean:.2f}" for name in HONESTY))
    return header, rows


def legend(scores: Sequence[Score]) -> str:
    """Return what the numbers of the table are."""
    several = "Mean ± half of the 95 % interval"
    one = "One episode has no interval: differences may be chance"
    chi2 = "chi2 is the squared error over its reported variance, 1 of an honest estimator"
    if not all(np.isfinite(each.means[name].mean) for each in scores for name in HONESTY):
        chi2 += ", inf of one that once was certain"
    return f"{one if scores[0].means[ERROR].n == 1 else several}. {chi2}"


def not_published(recordings: Recordings | None) -> str:
    """Return a sentence on errors over recorded vehicles; none over drawn ones and fields."""
    if recordings is None or not has_vehicles(recordings):
        return ""
    return ". Not to be published where drivers are real: errors depend on the true traffic"


def in_force(settings: Mapping[str, str]) -> str:
    """Return the settings of estimators in words."""
    return "; ".join(f"of {estimator}: {each}" for estimator, each in settings.items())


def policy_verdicts(
    rows: pl.DataFrame, scores: Sequence[Score], cells: Sequence[Cell]
) -> list[str]:
    """Return how the best learned policy stands to the best rule, a line for each estimator.

    Args:
        rows: Of the evaluation.
        scores: The least error of an estimator first.
        cells: What was played.
    """
    lines = []
    for estimator in dict.fromkeys(each.estimator for each in scores):
        learned, rules = _kinds([each for each in scores if each.estimator == estimator], cells)
        if not learned or not rules or learned[0].means[ERROR].n == 1:
            continue
        best, rule = learned[0], rules[0]
        own, other = ({"estimator": estimator, "policy": each.policy} for each in (best, rule))
        gain = below(rows, own, other)
        low, mean, high, side = gain.low, gain.mean, gain.high, "below"
        if mean < 0.0:
            low, mean, high, side = -high, -mean, -low, "above"
        name = f"best rule played ({rule.policy})" if len(rules) > 1 else rule.policy
        lines.append(
            f"{estimator}: learned ({best.policy}) {best.error:.1f}, {name} {rule.error:.1f}: "
            f"{mean:.1f} % {side}, 95 % interval {low:.1f} to {high:.1f}"
        )
    return lines


def estimator_verdicts(scores: Sequence[Score]) -> list[str]:
    """Return by how much other estimators err more than the best, a line for each policy."""
    lines = []
    for best in scores:
        others = [
            each for each in scores if each.policy == best.policy and each.estimator != best.least
        ]
        if best.estimator != best.least or not others or best.means[ERROR].n == 1:
            continue
        scale, more = 100.0 / best.error, []
        for each in sorted(others, key=lambda each: each.error):
            gap = each.estimator_differences[ERROR]
            more.append(f"{each.estimator} {scale * gap.mean:.1f} ± {scale * gap.half_width:.1f} %")
        lines.append(
            f"{best.policy}: {best.estimator} has the least error x 1000 ({best.error:.1f}); more "
            f"by {', '.join(more)}"
        )
    return lines


def _kinds(scores: Sequence[Score], cells: Sequence[Cell]) -> tuple[list[Score], list[Score]]:
    """Return the scores of learned policies, and of rules that could be played in their place."""
    sources = {cell.labels["policy"]: cell.policy for cell in cells}
    rules = {name for name, each in sources.items() if find_policy(each).is_schedule}
    return (
        [each for each in scores if each.policy not in rules],
        [each for each in scores if each.policy in rules - {ALL, *ORACLES}],
    )


def draw_scores(path: Path, title: str, scores: Sequence[Score], cells: Sequence[Cell]) -> None:
    """Draw the errors of all policies, with a colour for each estimator, or kind of policy."""
    series: dict[str, dict[str, dict[str, Interval]]] = {}
    learned, _ = _kinds(scores, cells)
    one = len({each.estimator for each in scores}) == 1
    for each in scores:
        kind = each.estimator if not one else "learned" if each in learned else "rule"
        shown = {error_label(metric): each.means[metric] for metric in METRICS}
        series.setdefault(kind, {})[each.policy] = shown
    policies = list(dict.fromkeys(each.policy for each in scores))
    save_figure(draw_errors(policies, series, log=not one), path, title)


def draw_traffic(args: Args, title: str, scores: Sequence[Score], cells: Sequence[Cell]) -> str:
    """Draw the first traffic seed, write the page if it is wanted, and say in words what is shown.

    A single policy is shown with the best four estimators. Of several policies the reference, the
    best other rule and the best two learned ones are, with the estimator of the least error.
    """
    own = [each for each in scores if each.estimator == scores[0].estimator]
    known = {tuple(cell.labels.values()): cell for cell in cells}
    reference = policy_name(find_reference(args))
    if len(own) == 1:
        own, common = list(scores), own[0].policy
        chosen = {each.estimator: (each.estimator, each.policy) for each in own[:4]}
    else:
        learned, rules = (
            [each.policy for each in kind if each.policy != reference]
            for kind in _kinds(own, cells)
        )
        common = own[0].estimator
        names = (reference, *rules[:1], *learned[:2])
        chosen = {name: (own[0].estimator, name) for name in names}
    seed = parse_seeds(args.test_seeds)[0]
    episodes = [watch(name, known[labels], seed, args.records) for name, labels in chosen.items()]
    history = episodes[0].history
    maps, last = [RoadMap("true density", history.truth, history)], episodes[-1].history.queried
    alike = all(np.array_equal(each.history.queried, last) for each in episodes)
    for each, (estimator, policy) in zip(episodes, chosen.values(), strict=True):
        maps.append(estimate_map(each.history, each.row[DENSITY], f"{each.name}: estimate"))
        queried = each.history.queried
        if each is episodes[-1] or not np.array_equal(queried, last):
            of = "" if alike or each.name == policy else f" with {estimator}"
            maps.append(RoadMap(f"segments queried by {policy}{of}", queried, history))
    figure = draw_maps([maps])
    save_figure(figure, args.output / MAPS, f"{title}: seed {seed}, {common}")
    if args.html:
        write_page(args.output / PAGE, title, *make_rows(own, reference), episodes, seed)
    return f"estimates and queries, {common}, traffic seed {seed}"


# The suite.


def enter(args: Args, tasks: Sequence[str]) -> None:
    """Play what was entered in tasks of the suite, write its card, and print errors and scores."""
    require(bool(args.policies), "policies", "given with --suite", args.policies)
    for name in tasks:
        require_name("suite", name, list(suite_tasks.TASKS))
    tasks = [name for name in suite_tasks.TASKS if name in tasks]
    fresh = None if args.fresh is None else integer("fresh", args.fresh, 2, MOST_SEEDS)
    draws = None if args.replay is None else integer("replay", args.replay, 1)
    require(draws is None or bool(args.beside), "replay", "given with cards beside", draws)
    rules, rows = suite.recorded()
    others = []
    for path in args.beside:
        try:
            other = suite.read(path, rules, rows)[1]
        except UnmeasuredError as problem:
            allowed = f"an entry with rows of these numbers; those of {problem} are missing"
            raise ValueError(f"beside must be {allowed}, got {path}") from problem
        on_fresh = fresh is not None or (other.entry is not None and other.entry.fresh is not None)
        fits = not on_fresh and list(other.errors) == tasks
        require(fits, "beside", "cards of the same tasks, on the traffic of the suite", str(path))
        others.append(other)
    entry = make_entry(args.policies, tasks)
    # A schedule by "module:Class" has a character that not every system allows in a path.
    own_folder = Path("results/my-suite") / entry.name.replace(":", "-")
    folder = own_folder if args.output == OUTPUT else args.output
    is_new = fresh and (folder / TABLES).exists()  # traffic for a finished entry is drawn anew
    require_output(folder, own=() if is_new else [CARD])
    place = args.place(folder)
    if draws is not None:
        for path in args.beside:
            largest = check(path, draws, args.records)
            args.remark(f"{path}: what was played again is as it says, to {100 * largest:.2g} %")
    for task, why in entry.left.items():
        args.remark(f"{entry.name} does not suit {task}, where {ROUND_ROBIN} acts: {why}")
    entry = begin(entry, folder, fresh, args.records)
    own = play("suite", tuple(entry.cells(rules)), (), place)
    schedule, line = suite.read(folder / CARD, rules, rows)
    header, lines = suite.compare([schedule, line, *others], rules)
    reads = "" if entry.reads == "observations" else f", reads the {entry.reads}"
    title = (
        f"{NAME}, errors x 1000 from second {WARM_UP + 1} on: {entry.name} ({entry.track}{reads})"
    )
    write_tables(folder, f"# {title}\n\n{markdown(header, lines)}", own)
    below = {"mean": line.scores.mean, **line.scores.tasks}
    scores = {name: each and dataclasses.asdict(each) for name, each in below.items()}
    content = {**read_json(folder / CARD), "below_the_best_rule": scores}
    args.answer(content, make_table(title, *header, rows=lines), f"the card is {folder / CARD}")
