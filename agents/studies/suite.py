"""The query suite: cells with fixed traffic and noise, in which any query policy is scored.

A score is the share of the way from the round robin (0) to the gain oracle (1). The rows of the
rules and policies that come with the package are in ``results/suite``; a policy of one's own is
scored against them, and gets a card.

dptse study suite
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from scipy import stats

from agents.environments import GUARANTEE, LONG, PAPER, PRIVATE, SHORT, guarantee_of
from agents.figures import GREY, finish_figure, make_figure, save_figure
from agents.play import Cell
from agents.policies import find_policy, policy_name
from agents.seeds import SUITE
from agents.statistics import Interval
from agents.study import ROWS, Study, read_table
from agents.tables import (
    ERROR,
    Labels,
    UnmeasuredError,
    are_present,
    below,
    cell,
    format_range,
    grid,
    markdown,
    mean,
    pick_paired,
    tenths,
    values_of,
)
from dptse_env.config import parse_seeds
from dptse_env.policies import shipped_policies
from dptse_env.utils.validation import number, parse_json, require
from dptse_env.versions import code_version, numbers_of

NAME = "query-suite-v3"
"""Changes with anything that a score depends on."""

ZERO, ONE = "round-robin", "oracle-gain"
"""Schedules of the scores 0 and 1."""

RECORDED = Path(__file__).parents[2] / "results" / "suite"
"""Folder of the rows that come with the package."""
FIGURE = "scores.png"

# Cells.

SEEDS, LONG_SEEDS = parse_seeds("2500:2532"), parse_seeds("2500:2508")
"""Test traffic of no other study: of roads of up to 15 segments, and of the long road."""

_EKF: Mapping[str, Any] = {"estimator": "ekf", "estimator_settings": None}
_PUBLISHED: Mapping[str, Any] = {"parameters": "published"}
# Weights by their name are part of what a cell is, so that rows of other weights are others.
_RECURRENT: Mapping[str, Any] = {
    "estimator": "recurrent",
    "estimator_settings": {"recurrent": {"weights": "highway-flows"}},
}
_SHORT_PACED: Mapping[str, Any] = {
    "privacy": {"preset": "paced", "epsilon": 5.0},
    "parameters": "w99-3lane",
}
_ELSEWHERE: Mapping[str, Any] = {
    "corridor": {
        "lanes": (4,) * 9 + (3,) * 6,
        "average_dwell": 6.8,
        "demand": {
            "base": {
                "mainline": [[0.0, 2700.0], [200.0, 7400.0], [400.0, 2700.0]],
                "on_ramps": [320.0, 300.0],
            }
        },
        "incident": None,
        "drivers": {"model": "IDM", "headway": 1.4, "speed_deviation": 0.1},
    }
}
"""A road whose fourth lane ends, with drivers by IDM and without incidents."""


def _cell(
    env: str, bandwidth: int, *keywords: Mapping[str, Any], seeds: tuple[int, ...] = SEEDS
) -> Cell:
    every = {name: value for each in keywords for name, value in each.items()}
    return Cell(
        env=env,
        keywords={"bandwidth": bandwidth, **every},
        noise_seed=SUITE.start,
        transferred=True,
        seeds=seeds,
    )


CELLS = {
    "short": _cell(SHORT, 1, _EKF, _PUBLISHED),
    "short-paced": _cell(SHORT, 1, _RECURRENT, _SHORT_PACED),
    "printed": _cell(PAPER, 5, _EKF),
    "capped": _cell(PRIVATE, 5, _EKF, {"privacy": "capped"}),
    "paced": _cell(PRIVATE, 1, _EKF),
    "paced-recurrent": _cell(PRIVATE, 1, _RECURRENT),
    "strict": _cell(PRIVATE, 2, _EKF, {"delta": 1e-6}),
    "connected": _cell(PAPER, 2, _EKF, {"penetration": 0.1}),
    "elsewhere": _cell(PRIVATE, 1, _EKF, _ELSEWHERE),
    "long": _cell(LONG, 2, _EKF, seeds=LONG_SEEDS),
}
"""Environments with their traffic seeds, by name; the policy is another one each time."""

RULES = (
    "shift-ahead", "static", "random", "oldest-first", "largest-variance", "stale-variance",
    "largest-deviation", "expected-reduction", "speed-front", ZERO,
)  # fmt: skip
"""Schedules that do without the truth."""
ORACLES = ("oracle-error", ONE)


def guarantee(name: str) -> str:
    """Return the guarantee of a cell, see `agents.environments.guarantee_of`."""
    return guarantee_of(CELLS[name].env, CELLS[name].keywords)


def make_cell(name: str, policy: str, source: str) -> Cell:
    """Return a cell of `CELLS` with a policy.

    Args:
        name: Name of the cell.
        policy: Name of the policy in tables.
        source: What `agents.policies.find_policy` takes.
    """
    return replace(CELLS[name], policy=source, labels={"name": name, "policy": policy})


def all_cells(policies: Sequence[str]) -> tuple[Cell, ...]:
    """Return all cells with all of some policies, whether they fit or not."""
    return tuple(make_cell(name, each, each) for name, each in product(CELLS, policies))


def enter(policies: Sequence[str], names: Sequence[str]) -> tuple[tuple[Cell, ...], str]:
    """Return cells with the first policy that suits each, and which are left out, and why.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: One of the policies acts in no cell.
    """
    entry = "+".join(map(policy_name, policies))
    reasons = dict.fromkeys(policies, "those before it act in all cells")
    found: dict[str, Cell] = {}
    for name, source in product(names, policies):
        made = make_cell(name, entry, source)
        if name not in found and (problem := made.misfit()) is None:
            found[name] = made
        elif name not in found:
            reasons[source] = reasons[name] = str(problem)
    acting = {each.policy for each in found.values()}
    for source in policies:
        if source not in acting:
            raise ValueError(f"{source!r} acts in no cell: {reasons[source]}")
    missing = [name for name in names if name not in found]
    why = f"{entry} does not suit {', '.join(missing)}: {reasons[missing[0]]}" if missing else ""
    return tuple(found.values()), why


def recorded_rows() -> pl.DataFrame:
    """Return the rows that come with the package, as far as they are of this state of it.

    Raises:
        ValueError: A reference was played with other numbers than those of this version, or with
            other weights.
    """
    rows = _present(read_table(RECORDED / ROWS))
    rows = rows.filter(are_present(rows))
    there = set(rows.select("policy", "name").iter_rows())
    for reference, name in product((ZERO, ONE), CELLS):
        if (reference, name) not in there:
            raise ValueError(
                f"{RECORDED / ROWS} has no {reference} in the cell {name!r} with the numbers of "
                f"dptse-env {code_version()}, so nothing can be scored; 'dptse study suite' in a "
                "checkout plays what is missing"
            )
    return rows


def _present(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows without those of weights and policies that came with the package before."""
    cells = all_cells((*RULES, *ORACLES, *shipped_policies()))
    return rows.filter(pl.col("cell").is_in([each.id for each in cells]))


# Scores.


class Score(NamedTuple):
    """The score of a policy in a cell.

    Attributes:
        value: The share of the way from the round robin to the gain oracle.
        parts: What each traffic seed adds to it beyond its expectation, to first order. Their sum
            is 0, and the root of the sum of their squares is the standard error.
    """

    value: float
    parts: Mapping[int, float]


def score(rows: pl.DataFrame, policy: str, name: str) -> Score:
    """Return the score of a policy in a cell.

    With mean errors E over traffic seeds it is (E_zero - E) / (E_zero - E_one), below 0 for a
    policy that is worse than the round robin. Its error is that of a ratio of means of paired
    values, by linearisation.

    Raises:
        UnmeasuredError: The policy and both references have no equal numbers, or the oracle is no
            better than the round robin, so that there is no scale.
    """
    labels = ({"policy": each, "name": name} for each in (ZERO, policy, ONE))
    paired = pick_paired(rows, *labels)
    start, reached, end = (values_of(each, ERROR) for each in paired)
    n, span = len(start), float((start - end).mean())
    if span <= 0.0:
        raise UnmeasuredError(policy, name)
    value = float((start - reached).mean()) / span
    parts = ((start - reached) - value * (start - end)) / (span * math.sqrt(n * (n - 1)))
    return Score(value, dict(zip(paired[0]["traffic_seed"], parts.tolist(), strict=True)))


def mean_score(scores: Sequence[Score]) -> Interval:
    """Return the mean of scores with its 95 % interval; of one, that score with its own.

    Cells share traffic seeds, whose parts may be alike; they are summed by seed before they are
    squared. Degrees of freedom are those of the cell with the fewest seeds.
    """
    value = float(np.mean([each.value for each in scores]))
    by_seed: dict[int, float] = {}
    for each in scores:
        for seed, part in each.parts.items():
            by_seed[seed] = by_seed.get(seed, 0.0) + part / len(scores)
    fewest = min(len(each.parts) for each in scores)
    error = math.sqrt(sum(part**2 for part in by_seed.values()))
    half = float(stats.t.ppf(0.975, fewest - 1)) * error
    return Interval(value, value - half, value + half, len(by_seed))


Scores = dict[str, dict[str, Score]]
"""Scores by policy and cell."""


def score_all(rows: pl.DataFrame) -> Scores:
    """Return the scores of all policies in some rows, the best mean first.

    What was not measured is left out, and who was not played in all cells comes last.
    """
    found: Scores = {policy: {} for policy in rows["policy"].unique().sort()}
    for policy, name in product(found, CELLS):
        try:
            found[policy][name] = score(rows, policy, name)
        except UnmeasuredError:
            continue

    def place(policy: str) -> tuple[bool, float]:
        scores = list(found[policy].values())
        return len(scores) < len(CELLS), -mean_score(scores).mean if scores else 0.0

    return {policy: found[policy] for policy in sorted(found, key=place)}


def format_scores(scores: Mapping[str, Score]) -> list[str]:
    """Return a policy's mean, a dash where a cell is missing, and its scores by cell."""
    in_order = [scores.get(name) for name in CELLS]
    present = [each for each in in_order if each is not None]
    found = [mean_score(present) if len(present) == len(CELLS) else None]
    found += [None if each is None else mean_score([each]) for each in in_order]
    return ["-" if each is None else f"{each.mean:.2f} ± {each.half_width:.2f}" for each in found]


def best_rule(rows: pl.DataFrame, name: str) -> str:
    """Return the rule of least error in a cell.

    Raises:
        UnmeasuredError: None was played.
    """
    there = set(rows.filter(name=name)["policy"])
    played = [rule for rule in RULES if rule in there]
    if not played:
        raise UnmeasuredError(name)
    return min(played, key=lambda rule: mean(rows, _labels(rule, name), ERROR).mean)


def beside_rules(rows: pl.DataFrame, policies: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of a table of scores by cell, with the best rule and the room."""
    names, scores = ("mean", *CELLS), score_all(rows)
    columns = {
        policy: dict(zip(names, format_scores(each), strict=True))
        for policy, each in scores.items()
    }

    def best(name: str) -> str:
        first = next(policy for policy in scores if policy in RULES)
        rule = first if name == "mean" else best_rule(rows, name)
        return f"{rule} {columns[rule][name]}"

    lines = [
        [
            name,
            guarantee(name) if name in CELLS else "-",
            *(columns[policy][name] for policy in policies),
            cell(best, name),
            cell(lambda name: tenths(room(rows, name)), name),
        ]
        for name in names
    ]
    return ["cell", GUARANTEE, *policies, "best rule", f"{ONE} below it [%]"], lines


def room(rows: pl.DataFrame, name: str) -> Interval:
    """Return by how much the gain oracle lies below the best rule in a cell [%], paired.

    Raises:
        UnmeasuredError: One of them was not played.
    """
    return below(rows, _labels(ONE, name), _labels(best_rule(rows, name), name))


def _labels(policy: str, name: str) -> Labels:
    return {"policy": policy, "name": name}


# Cards.


def comparable() -> dict[str, str]:
    """Return what cards must have in common: suite, numbers of the package, and all cells."""
    content = [[name, each.id, each.seeds] for name, each in CELLS.items()]
    digest = hashlib.sha256(json.dumps(content).encode()).hexdigest()
    return {"suite": NAME, "package": code_version(), "cells": digest}


def make_card(rows: pl.DataFrame, policy: str, cells: Sequence[Cell]) -> dict[str, Any]:
    """Return the card of a policy.

    Args:
        rows: Rows of the policy and of both references.
        policy: Its name in tables.
        cells: What was played, see `make_cell`.
    """
    scores = score_all(rows)[policy]
    everywhere = len(scores) == len(CELLS)
    played = {
        str(each.labels["name"]): {
            "name": policy_name(each.policy),
            "identity": find_policy(each.policy).identity,
        }
        for each in cells
    }
    return {
        **comparable(),
        "policy": policy,
        "policies": played,
        "score": _plain(mean_score(list(scores.values()))) if everywhere else None,
        "scores": {name: _plain(mean_score([each])) for name, each in scores.items()},
        "errors": {name: _errors(rows.filter(policy=policy, name=name)) for name in scores},
    }


def _errors(rows: pl.DataFrame) -> dict[str, float]:
    own = rows.sort("traffic_seed").select("traffic_seed", "reward")
    return {str(seed): -1000.0 * reward for seed, reward in own.iter_rows()}


def _plain(interval: Interval) -> dict[str, float]:
    return {"mean": interval.mean, "low": interval.low, "high": interval.high}


def read_card(path: Path) -> pl.DataFrame:
    """Return the errors of a card as rows of a policy, which has the file in its name.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no card, or cannot be compared with one of this suite and package.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there")
    card = parse_json(path.read_text(encoding="utf-8"), str(path))
    if not isinstance(card, dict) or not {*comparable(), "policy", "errors"} <= card.keys():
        raise ValueError(f"{path} must be a card that 'dptse evaluate --suite' wrote")
    for key, own in comparable().items():
        if card[key] != own and (key != "package" or numbers_of(f"{card[key]}") != numbers_of(own)):
            raise ValueError(
                f"{path} cannot be compared: its {key} is {card[key]!r:.80}, here it is {own!r}"
            )
    policy, errors, rows = f"{card['policy']} ({path})", card["errors"], []
    require(isinstance(errors, dict) and bool(errors), f"{path}: errors", "by cell", errors)
    for name, by_seed in errors.items():
        seeds = [str(seed) for seed in CELLS[name].seeds or ()] if name in CELLS else []
        allowed = "numbers of all traffic seeds of a cell"
        fits = isinstance(by_seed, dict) and seeds and sorted(by_seed) == sorted(seeds)
        require(bool(fits), f"{path}: errors[{name!r}]", allowed, by_seed)
        for seed in seeds:
            error = number(float, by_seed[seed], f"{path}: errors[{name!r}][{seed!r}]", None)
            labels = _labels(policy, name)
            rows.append({**labels, "traffic_seed": int(seed), "reward": -error / 1000.0})
    return pl.DataFrame(rows).with_columns(version=pl.lit(code_version()))


# The report on all that comes with the package.


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw the scores."""
    rows = _present(rows)
    scores = score_all(rows)
    draw_scores(scores, folder / FIGURE)
    heads = {f"`{name}`, {guarantee(name)}".removesuffix(", none"): name for name in CELLS}
    lines = [[f"`{policy}`", *format_scores(each)] for policy, each in scores.items()]
    return "\n\n".join(
        [
            f"# {NAME}",
            "## Scores",
            markdown(["policy", "mean", *heads], lines),
            "## What is to be won",
            markdown(*beside_rules(rows, ())),
            "## Errors x 1000",
            grid(
                "policy",
                list(scores),
                list(heads),
                lambda policy, head: f"{mean(rows, _labels(policy, heads[head]), ERROR).mean:.1f}",
            ),
            "## Cells",
            _cell_table(),
        ]
    )


def _cell_table() -> str:
    lines = [
        [
            f"`{name}`",
            f"`{each.env.rpartition('/')[2]} {json.dumps(each.keywords)}`",
            guarantee(name),
            format_range(each.seeds or ()),
        ]
        for name, each in CELLS.items()
    ]
    return markdown(["cell", "environment", GUARANTEE, "traffic seeds"], lines)


_LEAST = -0.5


def draw_scores(scores: Scores, path: Path) -> None:
    """Save the scores of all policies but the references, dots by cell."""
    heights = {name: -k for k, name in enumerate(CELLS)}
    figure = make_figure(8.4, 2.0 + 0.34 * len(CELLS))
    axis = figure.subplots()
    shown = {
        policy: {name: each.value for name, each in found.items() if each.value > _LEAST}
        for policy, found in scores.items()
        if policy not in (ZERO, ONE)
    }
    for k, policy in enumerate(name for name, values in shown.items() if values):
        values = shown[policy]
        marker = "D" if policy in shipped_policies() else "o^s"[k // 10 % 3]
        places = [heights[name] for name in values]
        axis.plot(
            list(values.values()), places, marker, color=f"C{k % 10}", label=policy, markersize=5
        )
    for place in (0.0, 1.0):
        axis.axvline(place, color=GREY, linewidth=0.8)
    axis.set_xlim(_LEAST, 1.05)
    axis.set_xlabel(f"score, those below {_LEAST} left out")
    axis.set_yticks(list(heights.values()), list(heights))
    title = f"{NAME}: 0 is the round robin, 1 the gain oracle"
    save_figure(finish_figure(figure, columns=4), path, title)


STUDY = Study(
    "suite",
    all_cells((*RULES, *ORACLES)),
    SEEDS,
    report,
    follow=lambda rows, place: [
        each for each in all_cells(shipped_policies()) if each.misfit() is None
    ],
)
