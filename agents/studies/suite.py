"""The query suite: thirteen tasks with fixed traffic and noise, on which any policy is scored.

In each task the paper's schedule has the score 0 and the error oracle 1. The rows of the policies
that come with the package are in ``results/suite``; those of another one are put beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy import stats

import dptse_env
from agents.environments import make_config, quietly
from agents.figures import GREY, add_frame, add_legend, make_figure, save_figure
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
    cell,
    format_range,
    markdown,
    pick,
    pick_pair,
    values_of,
)
from dptse_env.config import parse_seeds
from dptse_env.parts import privacy_report

NAME = "query-suite-v2"
"""Changes with anything that a score depends on."""

PAPER, PRIVATE = "dptse_env:dptse/PaperHighway-v0", "dptse_env:dptse/PrivateHighway-v0"
PACED, SHORT = "dptse_env:dptse/PrivateHighway-v1", "dptse_env:dptse/ShortHighway-v0"
LONG = "dptse_env:dptse/LongHighway-v0"
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
        """What the release model guarantees to a trip, as (epsilon, delta), or that it does not."""
        with quietly():
            report = privacy_report(make_config(self.env, self.keywords))
        pair = f"({report.epsilon:.4g}, {report.claimed_delta:g})"
        return f"none: {pair}" if report.void_reasons else pair


_TWO_PEAKS = {
    "base": {
        "mainline": [[0.0, 5000.0], [120.0, 2000.0], [300.0, 5600.0], [420.0, 3000.0]],
        "on_ramps": [150.0, 600.0],
    }
}


def _task(name: str, meaning: str, env: str, estimator: str, bandwidth: int, **more: Any) -> Task:
    keywords = {"estimator": estimator, "bandwidth": bandwidth, **more}
    return Task(name, meaning, env, keywords, LONG_SEEDS if env == LONG else ROAD_SEEDS)


TASKS = (
    _task("paper", "PaperHighway-v0, noise as printed, EKF, B = 5", PAPER, "ekf", 5),
    _task("capped-ekf-5", "PrivateHighway-v0, EKF, B = 5", PRIVATE, "ekf", 5),
    _task("capped-recurrent-5", "PrivateHighway-v0, recurrent, B = 5", PRIVATE, "recurrent", 5),
    _task("paced-ekf-2", "PrivateHighway-v1, EKF, B = 2", PACED, "ekf", 2),
    _task("paced-recurrent-2", "PrivateHighway-v1, recurrent, B = 2", PACED, "recurrent", 2),
    _task("paced-recurrent-5", "PrivateHighway-v1, recurrent, B = 5", PACED, "recurrent", 5),
    _task(
        "other-drivers", "paced-recurrent-2 with drivers by Krauss and two peaks of demand",
        PACED, "recurrent", 2, demand=_TWO_PEAKS, corridor={"drivers": {"model": "Krauss"}},
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
        PACED, "recurrent", 5, penetration=0.1, corridor={"fixed_sensors": [3, 7, 11]},
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
        "paced-ekf-2", "paced-recurrent-2", "paced-recurrent-5", "other-drivers", "short",
        "long-recurrent-8", "long-ekf-4", "long-recurrent-2",
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
    scores = Scores(rows, tasks)
    scores.draw(folder / FIGURE)
    parts = [f"# {NAME}", "## Scores", scores.table(), "## Tasks", _task_table(rows, tasks)]
    for task in tasks:
        parts += [f"## `{task.name}`", _policy_table(rows, task, scores.policies)]
    return "\n\n".join(parts)


def score(rows: pl.DataFrame, policy: str, task: str) -> Interval:
    """Return a normalised score with its 95 % interval over traffic seeds, paired.

    With mean errors E, it is (E_zero - E) / (E_zero - E_one), above 1 for a policy that is better
    than the oracle. The interval is that of a ratio of means of paired values, by linearisation.

    Raises:
        UnmeasuredError: No version has played the policy and both references, or the oracle is no
            better than the paper's schedule, so that there is no scale.
    """
    own, zero = pick_pair(rows, _labels(policy, task), _labels(ZERO, task))
    again, one = pick_pair(rows, _labels(policy, task), _labels(ONE, task))
    base, reached, best = (values_of(each, ERROR) for each in (zero, own, one))
    if not own.equals(again) or base.mean() <= best.mean():
        raise UnmeasuredError(policy, task)
    span = float((base - best).mean())
    value = float((base - reached).mean()) / span
    residual = (base - reached) - value * (base - best)
    half = float(stats.t.ppf(0.975, len(base) - 1)) * float(stats.sem(residual)) / span
    return Interval(value, value - half, value + half, len(base))


def _labels(policy: str, task: str) -> Labels:
    return {"policy": policy, "task": task}


class Scores:
    """Scores of all policies in some rows.

    Attributes:
        by_task: By policy and task; what was not measured is left out.
        policies: Policies, the best mean first, and then those that have none.
    """

    def __init__(self, rows: pl.DataFrame, tasks: Sequence[Task] = TASKS) -> None:
        """Score them."""
        self._tasks = [task.name for task in tasks]
        self.by_task: dict[tuple[str, str], Interval] = {}
        policies: list[str] = rows["policy"].unique().sort().to_list()
        for policy in policies:
            for task in self._tasks:
                try:
                    self.by_task[policy, task] = score(rows, policy, task)
                except UnmeasuredError:
                    continue
        self.policies = sorted(policies, key=self._order)

    def _order(self, policy: str) -> tuple[bool, float]:
        mean = self.mean(policy)
        return mean is None, 0.0 if mean is None else -mean

    def mean(self, policy: str) -> float | None:
        """Return the mean over all tasks; None where one is missing."""
        found = [self.by_task.get((policy, task)) for task in self._tasks]
        means = [each.mean for each in found if each is not None]
        return float(np.mean(means)) if len(means) == len(found) else None

    def best(self, task: str, among: Sequence[str]) -> str | None:
        """Return the policy with the best score in a task, if any has one."""
        known = [policy for policy in among if (policy, task) in self.by_task]
        return max(known, key=lambda policy: self.by_task[policy, task].mean, default=None)

    def shown(self, policy: str, task: str) -> str:
        """Return a score with half of its interval.

        Raises:
            UnmeasuredError: There is none.
        """
        if (policy, task) not in self.by_task:
            raise UnmeasuredError(policy, task)
        found = self.by_task[policy, task]
        return f"{found.mean:.2f} ± {found.half_width:.2f}"

    def table(self) -> str:
        """Return the scores as Markdown, the best mean first."""
        lines = []
        for policy in self.policies:
            mean = self.mean(policy)
            shown = [cell(self.shown, policy, task) for task in self._tasks]
            lines.append([f"`{policy}`", "-" if mean is None else f"{mean:.2f}", *shown])
        return markdown(["policy", "mean", *(f"`{task}`" for task in self._tasks)], lines)

    def draw(self, path: Path) -> None:
        """Save the scores of all policies but the references, one panel of dots by task."""
        shown = [policy for policy in self.policies if policy not in (ZERO, ONE)]
        figure = make_figure(8.4, 1.7 + 0.34 * len(self._tasks))
        axis = figure.subplots()
        places = np.arange(len(self._tasks))[::-1]
        for k, policy in enumerate(shown):
            marker = _MARKERS[k // 10 % len(_MARKERS)]
            found = [
                (self.by_task[policy, task].mean, place)
                for task, place in zip(self._tasks, places, strict=True)
                if (policy, task) in self.by_task
            ]
            scores, heights = np.array(found).reshape(-1, 2).T
            axis.plot(scores, heights, marker, color=f"C{k % 10}", label=policy)
        axis.axvline(0.0, color=GREY, linewidth=0.8)
        axis.set_xlim(-0.5, 1.05)
        axis.set_xlabel("score, those below -0.5 left out")
        axis.set_yticks(places, self._tasks)
        add_frame(axis)
        add_legend(figure, [axis])
        save_figure(figure, path, f"{NAME}: 0 is the paper's schedule, 1 the error oracle")


_MARKERS = ("o", "^", "s")


def _task_table(rows: pl.DataFrame, tasks: Sequence[Task]) -> str:
    """Return the tasks with their traffic, guarantees, and the errors of both references."""

    def reference(name: str, task: str) -> str:
        return f"{values_of(pick(rows, _labels(name, task)), ERROR).mean():.1f}"

    def seeds(task: str) -> str:
        return format_range(pick(rows, _labels(ZERO, task))["traffic_seed"].to_list())

    header = ["task", "what it is", "traffic seeds", "guarantee", f"`{ZERO}`: 0", f"`{ONE}`: 1"]
    return markdown(
        header,
        [
            [
                f"`{task.name}`",
                task.meaning,
                cell(seeds, task.name),
                task.guarantee,
                cell(reference, ZERO, task.name),
                cell(reference, ONE, task.name),
            ]
            for task in tasks
        ],
    )


def _policy_table(rows: pl.DataFrame, task: Task, policies: Sequence[str]) -> str:
    """Return errors, honesty and queries of the policies in a task, the least error first."""
    lines = []
    for policy in policies:
        try:
            own = pick(rows, _labels(policy, task.name))
        except UnmeasuredError:
            continue
        error, density, speed, chi2_density, chi2_speed, queries = (
            float(values_of(own, metric).mean())
            for metric in (ERROR, DENSITY, SPEED, "chi2_density", "chi2_speed", "queries_a_second")
        )
        met, refused = (float(own[name].sum()) for name in ("n_met", "n_refused"))
        numbers = [
            f"{error:.1f}",
            f"{density:.2f}",
            f"{speed:.2f}",
            f"{chi2_density:.2f}, {chi2_speed:.2f}",
            f"{100.0 * refused / met:.1f}" if met else "-",
            f"{queries:.1f}",
        ]
        lines.append((error, [f"`{policy}`", *numbers]))
    header = [
        "policy", "error x 1000", "density [veh/km]", "speed [km/h]", "χ²", "refused [%]",
        "queries a second",
    ]  # fmt: skip
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
