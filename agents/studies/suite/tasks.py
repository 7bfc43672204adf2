"""The tasks of the query suite: environments with fixed traffic and noise.

All have the estimator ``recurrent``. Keywords are written out, so that a task stays what it is
where the defaults of an id change.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from agents.environments import LONG, PAPER, PRIVATE, SHORT
from agents.play import Cell
from agents.policies import find_policy
from agents.seeds import CHOICE, SUITE
from dptse_env.config import parse_seeds
from dptse_env.schedules import ORACLES

NAME = "query-suite-v4"
"""Changes with anything that a score depends on."""

PAPER_SCHEDULE, ROUND_ROBIN = "shift-ahead", "round-robin"
ADVISED = "largest-deviation", "expected-reduction"
RULES = (
    PAPER_SCHEDULE, ROUND_ROBIN, "oldest-first", "largest-variance", "stale-variance",
    "speed-front", *ADVISED,
)  # fmt: skip
"""Schedules that may be the best rule of a task. ``static``, ``random`` and
``largest-density-variance`` were so in none."""

VALIDATION, TEST, EKF = "validation", "test", "ekf"
"""Parts of the study, in the column ``part`` of its rows."""


class Task(NamedTuple):
    """An environment in which policies are compared.

    Attributes:
        env: Environment id.
        keywords: Its keywords.
        seeds: Test traffic, of no other study.
        validation: Traffic on which its rule is chosen.
        is_held_out: Whether entries may not be trained on its road.
    """

    env: str
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    validation: tuple[int, ...]
    is_held_out: bool = False


def _task(
    env: str,
    preset: str,
    horizon: int,
    *,
    seeds: int = 64,
    validation: int = 40,
    epsilon: float = 5.0,
    delta: float = 0.05,
    cap: Mapping[str, int] | None = None,
    held_out: bool = False,
    **more: Any,
) -> Task:
    keywords = {
        "estimator": "recurrent",
        "estimator_settings": None,
        "parameters": "w99-3lane",
        "bandwidth": 1,
        "query_every": 1,
        "horizon": horizon,
        "privacy": {"preset": preset, "epsilon": epsilon, "delta": delta, **(cap or {})},
        **more,
    }
    test, chosen = f"2500:{2500 + seeds}", f"1500:{1500 + validation}"
    return Task(env, keywords, parse_seeds(test), parse_seeds(chosen), held_out)


_LORRIES = tomllib.loads(Path(__file__).with_name("lorries.toml").read_text(encoding="utf-8"))
_LOOPS = {"loops": {"positions": [0.0, 0.7, 1.4], "interval": 20}}

TASKS = {
    "short-printed": _task(SHORT, "printed", 240, epsilon=1.0, seeds=256, validation=128),
    "short-corrected": _task(SHORT, "corrected", 240, seeds=256, validation=128),
    "short-capped": _task(SHORT, "capped", 240, seeds=256, validation=128),
    "short-every-fourth": _task(
        SHORT, "printed", 240, epsilon=1.0, query_every=4, seeds=256, validation=128
    ),
    "paper-printed": _task(PAPER, "printed", 700, epsilon=1.0),
    "paper-capped": _task(PAPER, "capped", 700, bandwidth=5),
    "paper-cap-16": _task(PAPER, "capped", 700, cap={"cap": 16}),
    "private-paced": _task(PRIVATE, "paced", 700),
    "private-strict": _task(PRIVATE, "paced", 700, delta=1e-6),
    "connected": _task(PRIVATE, "paced", 700, penetration=0.1, corridor=_LOOPS),
    "lorries": _task(PRIVATE, "paced", 720, held_out=True, **_LORRIES),
    "long": _task(LONG, "paced", 1200, bandwidth=2, seeds=12, validation=6, held_out=True),
}
"""Tasks by name."""


def make_cell(
    task: str,
    policy: str,
    *,
    part: str = TEST,
    seeds: tuple[int, ...] | None = None,
    **more: Any,
) -> Cell:
    """Return a policy in a task.

    Args:
        task: Name of the task.
        policy: What `agents.policies.find_policy` takes; its rows are labelled by its identity.
        part: Part of the study.
        seeds: Traffic seeds; those of the task's part if None.
        **more: Keywords that differ from the task's.
    """
    own = TASKS[task]
    given = own.validation if part == VALIDATION else own.seeds
    labels = {"part": part, "task": task, "policy": find_policy(policy).identity}
    return Cell(
        env=own.env,
        policy=policy,
        keywords={**own.keywords, **more},
        labels=labels | ({"estimator": str(more["estimator"])} if more else {}),
        # A choice and a report never share noise.
        noise_seed=(CHOICE if part == VALIDATION else SUITE).start,
        transferred=True,
        seeds=given if seeds is None else seeds,
    )


# What the study plays.

MARKS, MARKED, MARKS_SEEDS = tuple(ORACLES), ("short-printed", "paper-capped", "private-paced"), 16
"""Schedules that see the truth, and mark what an error may come to; the tasks where they do, on so
many traffic seeds."""

CALIBRATED, REPAIRED = "ekf", "agents.studies.suite.repaired:RepairedEKF"
"""Estimators of the appendix, which plays the marked tasks with the EKF: as it is calibrated, and
with deviations that say where it errs."""


def references(rule: str) -> tuple[str, ...]:
    """Return the schedules that are played wherever an entry is, the task's rule among them."""
    return tuple(dict.fromkeys((PAPER_SCHEDULE, ROUND_ROBIN, *ADVISED, rule)))


def mark_cell(task: str, policy: str) -> Cell:
    """Return a mark in a task."""
    return make_cell(task, policy, seeds=TASKS[task].seeds[:MARKS_SEEDS])


def ekf_cell(task: str, policy: str, estimator: str = CALIBRATED) -> Cell:
    """Return a policy in a task with an EKF."""
    given: dict[str, Any] = {"part": EKF, "seeds": TASKS[task].seeds[:MARKS_SEEDS]}
    if estimator == REPAIRED:  # whose settings are none of its own
        given["estimator_settings"] = ekf_cell(task, policy).config.settings_name
    return make_cell(task, policy, **given, estimator=estimator)


def validation_cells() -> list[Cell]:
    """Return all rules on the traffic that chooses."""
    return [make_cell(task, rule, part=VALIDATION) for task in TASKS for rule in RULES]


def test_cells(rules: Mapping[str, str]) -> list[Cell]:
    """Return what the tables have beside entries, in the tasks of some rules."""
    cells = [make_cell(task, each) for task in rules for each in references(rules[task])]
    for task in (name for name in MARKED if name in rules):
        cells += [mark_cell(task, mark) for mark in MARKS]
        cells += [ekf_cell(task, rule) for rule in (PAPER_SCHEDULE, ROUND_ROBIN, *ADVISED)]
        cells.append(ekf_cell(task, ADVISED[1], REPAIRED))
    return cells
