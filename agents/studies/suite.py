"""The query suite: fourteen tasks with fixed traffic and noise, on which any policy is scored.

In each task the paper's schedule has the score 0 and the error oracle 1. The rows of the policies
that come with the package are in ``results/suite``; those of another one are put beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy import stats

import dptse_env
from agents.environments import OTHER_DRIVERS, make_config, quietly
from agents.figures import GREY, finish_figure, make_figure, save_figure
from agents.play import Cell
from agents.seeds import SUITE
from agents.statistics import Interval
from agents.study import ROWS, Study, read_table
from agents.tables import (
    DENSITY,
    ERROR,
    SPEED,
    Labels,
    UnmeasuredError,
    format_range,
    markdown,
    pick,
    pick_paired,
    values_of,
)
from dptse_env.config import parse_seeds
from dptse_env.parts import privacy_report

NAME = "query-suite-v3"
"""Changes with anything that a score depends on."""

PAPER, PRIVATE = "dptse_env:dptse/PaperHighway-v0", "dptse_env:dptse/PrivateHighway-v1"
LONG, SHORT = "dptse_env:dptse/LongHighway-v0", "dptse_env:dptse/ShortHighway-v0"
ZERO, ONE = "paper", "oracle-error"
"""Schedules of the scores 0 and 1."""

ROAD_SEEDS, LONG_SEEDS = parse_seeds("2500:2548"), parse_seeds("2500:2516")
"""Test traffic of no other study: of roads of up to 15 segments, and of the long road."""

RECORDED = Path(__file__).parents[2] / "results" / "suite"
"""Folder of the rows that come with the package."""
FIGURE = "scores.png"


@dataclass(frozen=True)
class Task:
    """An environment in which policies are scored.

    Attributes:
        name: Name in tables.
        meaning: The road, the release model, the estimator and the bandwidth.
        env: Environment id.
        keywords: Keywords of the environment but for the action encoding, which is the policy's.
        seeds: Traffic seeds.
    """

    name: str
    meaning: str
    env: str
    keywords: Mapping[str, Any] = field(hash=False)
    seeds: tuple[int, ...] = ROAD_SEEDS

    @cached_property
    def guarantee(self) -> str:
        """The guarantee for a trip, as mu and (epsilon, delta), or that there is none."""
        with quietly():
            report = privacy_report(make_config(self.env, self.keywords))
        pair = f"μ = {report.mu:.2f}, ({report.epsilon:.4g}, {report.claimed_delta:g})"
        return f"none: {pair}" if report.void_reasons else pair


def _task(name: str, meaning: str, env: str, estimator: str, bandwidth: int, **more: Any) -> Task:
    keywords = {"estimator": estimator, "bandwidth": bandwidth, **more}
    return Task(name, meaning, env, keywords, LONG_SEEDS if env == LONG else ROAD_SEEDS)


TASKS = (
    _task("paper", "PaperHighway-v0, noise as printed, EKF, B = 5", PAPER, "ekf", 5),
    _task(
        "capped-ekf-5", "PrivateHighway-v1, capped, EKF, B = 5", PRIVATE, "ekf", 5,
        privacy="capped",
    ),
    _task(
        "capped-recurrent-5", "PrivateHighway-v1, capped, recurrent, B = 5", PRIVATE,
        "recurrent", 5, privacy="capped",
    ),
    _task("paced-ekf-2", "PrivateHighway-v1, EKF, B = 2", PRIVATE, "ekf", 2),
    _task("paced-recurrent-2", "PrivateHighway-v1, recurrent, B = 2", PRIVATE, "recurrent", 2),
    _task("paced-recurrent-5", "PrivateHighway-v1, recurrent, B = 5", PRIVATE, "recurrent", 5),
    _task(
        "strict-recurrent-2", "paced-recurrent-2 with a delta of 1e-06", PRIVATE, "recurrent", 2,
        delta=1e-6,
    ),
    _task(
        "other-drivers", "paced-recurrent-2 with drivers by Krauss and two peaks of demand",
        PRIVATE, "recurrent", 2, **OTHER_DRIVERS,
    ),
    _task(
        "short", "ShortHighway-v0, paced, recurrent, B = 1", SHORT, "recurrent", 1,
        privacy={"preset": "paced", "epsilon": 5.0}, parameters="w99-3lane",
    ),
    _task(
        "long-capped-recurrent-8", "LongHighway-v0, capped, recurrent, B = 8", LONG,
        "recurrent", 8, privacy={"preset": "capped", "epsilon": 5.0, "cap": 64},
    ),
    _task("long-recurrent-8", "LongHighway-v0, recurrent, B = 8", LONG, "recurrent", 8),
    _task("long-ekf-4", "LongHighway-v0, EKF, B = 4", LONG, "ekf", 4),
    _task("long-recurrent-2", "LongHighway-v0, recurrent, B = 2", LONG, "recurrent", 2),
    _task(
        "connected-recurrent-5",
        "paced-recurrent-5 with one vehicle in ten connected, and detectors on segments 3, 7, 11",
        PRIVATE, "recurrent", 5, penetration=0.1, corridor={"fixed_sensors": [3, 7, 11]},
    ),
)  # fmt: skip

RULES = (
    ZERO, "static", "round-robin", "random", "oldest-first", "largest-variance", "stale-variance",
    "largest-deviation", "expected-reduction", "speed-front", ONE,
)  # fmt: skip
_CAPPED = ("capped-ekf-5", "capped-recurrent-5", "long-capped-recurrent-8")
LEARNED = {
    "private-highway": _CAPPED,
    "capped-roads": _CAPPED,
    "paced-roads": (
        "paced-ekf-2", "paced-recurrent-2", "paced-recurrent-5", "strict-recurrent-2",
        "other-drivers", "short", "long-recurrent-8", "long-ekf-4", "long-recurrent-2",
    ),
}  # fmt: skip
"""Policies that come with the package, and the tasks with the observations that they know."""


def make_cell(task: Task, name: str, policy: str) -> Cell:
    """Return the cell of a policy in a task.

    Args:
        task: The task.
        name: Name of the policy in tables.
        policy: What `agents.policies.find_policy` takes.
    """
    return Cell(
        env=task.env,
        policy=policy,
        keywords=task.keywords,
        labels={"task": task.name, "policy": name},
        noise_seed=SUITE.start,
        transferred=True,
        watchers=("summary",),
        seeds=task.seeds,
    )


def entry(cells: Sequence[Cell], tasks: Sequence[Task] = TASKS) -> Study:
    """Return a study of some policies, whose report has them beside those that are recorded.

    Scores need both references of the same version: where none is recorded, they are played, too.

    Args:
        cells: Cells of the policies, see `make_cell`.
        tasks: Tasks in the order of the tables.
    """
    recorded = read_table(RECORDED / ROWS).filter(pl.col("version") == dptse_env.__version__)
    present = set(recorded.select("policy", "task").iter_rows())
    played = {each.labels["task"] for each in cells}
    references = [
        make_cell(task, name, name)
        for task in tasks
        for name in (ZERO, ONE)
        if task.name in played and (name, task.name) not in present
    ]
    wanted = (*cells, *references)
    return Study(
        "suite",
        wanted,
        ROAD_SEEDS,
        lambda rows, folder: report(beside_recorded(rows, wanted), folder, tasks),
    )


def beside_recorded(rows: pl.DataFrame, cells: Sequence[Cell]) -> pl.DataFrame:
    """Return the rows of some cells, and those that come with the package.

    A folder may have rows of an earlier state of the same file, which is another cell.
    """
    own = rows.filter(pl.col("cell").is_in([each.id for each in cells]))
    both: pl.DataFrame = pl.concat([read_table(RECORDED / ROWS), own], how="diagonal_relaxed")
    return both.unique(("version", "cell", "traffic_seed"), keep="last", maintain_order=True)


def report(rows: pl.DataFrame, folder: Path, tasks: Sequence[Task] = TASKS) -> str:
    """Return the tables, and draw the scores."""
    scores = score_all(rows, tasks)
    draw_scores(scores, tasks, folder / FIGURE)
    parts = [f"# {NAME}", "## Scores", _score_table(scores, tasks)]
    parts += ["## Tasks", _task_table(tasks)]
    for task in tasks:
        parts += [f"## `{task.name}`", _policy_table(rows, task)]
    return "\n\n".join(parts)


def score(rows: pl.DataFrame, policy: str, task: str) -> Interval:
    """Return a normalised score with its 95 % interval over traffic seeds, paired.

    With mean errors E, it is (E_zero - E) / (E_zero - E_one), above 1 for a policy that is better
    than the oracle. The interval is that of a ratio of means of paired values, by linearisation.

    Raises:
        UnmeasuredError: No version has played the policy and both references, or the oracle is no
            better than the paper's schedule, so that there is no scale.
    """
    paired = pick_paired(rows, *(_labels(name, task) for name in (ZERO, policy, ONE)))
    base, reached, best = (values_of(each, ERROR) for each in paired)
    if base.mean() <= best.mean():
        raise UnmeasuredError(policy, task)
    span = float((base - best).mean())
    value = float((base - reached).mean()) / span
    residual = (base - reached) - value * (base - best)
    half = float(stats.t.ppf(0.975, len(base) - 1)) * float(stats.sem(residual)) / span
    return Interval(value, value - half, value + half, len(base))


def _labels(policy: str, task: str) -> Labels:
    return {"policy": policy, "task": task}


Scores = dict[str, dict[str, Interval]]
"""Scores by policy and task."""


def score_all(rows: pl.DataFrame, tasks: Sequence[Task] = TASKS) -> Scores:
    """Return the scores of all policies in some rows, the best mean first.

    What was not measured is left out, and who has no mean comes last.
    """
    found: Scores = {policy: {} for policy in rows["policy"].unique().sort()}
    for policy, task in product(found, tasks):
        try:
            found[policy][task.name] = score(rows, policy, task.name)
        except UnmeasuredError:
            continue

    def place(policy: str) -> float:
        mean = mean_score(found[policy], tasks)
        return np.inf if mean is None else -mean

    return {policy: found[policy] for policy in sorted(found, key=place)}


def mean_score(by_task: Mapping[str, Interval], tasks: Sequence[Task] = TASKS) -> float | None:
    """Return the mean of a policy's scores over all tasks; None where one is missing."""
    if len(by_task) < len(tasks):
        return None
    return float(np.mean([each.mean for each in by_task.values()]))


def format_scores(by_task: Mapping[str, Interval], tasks: Sequence[Task]) -> list[str]:
    """Return a policy's mean and its scores with half of their intervals, dashes for none."""
    mean, found = mean_score(by_task, tasks), [by_task.get(task.name) for task in tasks]
    return [
        "-" if mean is None else f"{mean:.2f}",
        *("-" if each is None else f"{each.mean:.2f} ± {each.half_width:.2f}" for each in found),
    ]


def _score_table(scores: Scores, tasks: Sequence[Task]) -> str:
    lines = [[f"`{policy}`", *format_scores(each, tasks)] for policy, each in scores.items()]
    return markdown(["policy", "mean", *(f"`{task.name}`" for task in tasks)], lines)


def draw_scores(scores: Scores, tasks: Sequence[Task], path: Path) -> None:
    """Save the scores of all policies but the references, one panel of dots by task."""
    heights = {task.name: -k for k, task in enumerate(tasks)}
    figure = make_figure(8.4, 1.7 + 0.34 * len(tasks))
    axis = figure.subplots()
    for k, policy in enumerate(name for name in scores if name not in (ZERO, ONE)):
        means = [each.mean for each in scores[policy].values()]
        marker = "o^s"[k // 10 % 3]
        places = [heights[task] for task in scores[policy]]
        axis.plot(means, places, marker, color=f"C{k % 10}", label=policy)
    axis.axvline(0.0, color=GREY, linewidth=0.8)
    axis.set_xlim(-0.5, 1.05)
    axis.set_xlabel("score, those below -0.5 left out")
    axis.set_yticks(list(heights.values()), list(heights))
    title = f"{NAME}: 0 is the paper's schedule, 1 the error oracle"
    save_figure(finish_figure(figure), path, title)


def _task_table(tasks: Sequence[Task]) -> str:
    header = ["task", "what it is", "traffic seeds", "guarantee"]
    return markdown(
        header,
        [
            [f"`{task.name}`", task.meaning, format_range(task.seeds), task.guarantee]
            for task in tasks
        ],
    )


_COLUMNS = {
    DENSITY: "density [veh/km]",
    SPEED: "speed [km/h]",
    "chi2_density": "χ² of density",
    "chi2_speed": "χ² of speed",
}


def _policy_table(rows: pl.DataFrame, task: Task) -> str:
    """Return errors, honesty and refusals of the policies in a task, the least error first."""
    lines = []
    for policy in rows.filter(task=task.name)["policy"].unique().sort():
        own = pick(rows, _labels(policy, task.name))
        error = values_of(own, ERROR).mean()
        met, refused = (float(own[name].sum()) for name in ("n_met", "n_refused"))
        numbers = [f"{values_of(own, name).mean():.2f}" for name in _COLUMNS]
        share = f"{100.0 * refused / met:.1f}" if met else "-"
        lines.append((error, [f"`{policy}`", f"{error:.1f}", *numbers, share]))
    header = ["policy", "error x 1000", *_COLUMNS.values(), "refused [%]"]
    return markdown(header, [line for _, line in sorted(lines)])


STUDY = Study(
    "suite",
    (
        *(make_cell(task, rule, rule) for rule in RULES for task in TASKS),
        *(
            make_cell(task, policy, policy)
            for policy, suited in LEARNED.items()
            for task in TASKS
            if task.name in suited
        ),
    ),
    ROAD_SEEDS,
    report,
)
