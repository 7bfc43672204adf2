"""Figures of the study of policies."""

from __future__ import annotations

from itertools import cycle

import numpy as np
from matplotlib.figure import Figure

from agents.figures import draw_dot, finish_figure, make_figure
from agents.statistics import mean
from agents.studies.policies.plan import PRIMARY, REFERENCE, Entry
from agents.studies.policies.queries import (
    BIN,
    NEAR,
    PHASES,
    QueryCounts,
    by_offset,
    by_segment,
    near_since_start,
)
from agents.studies.policies.results import METRICS, PolicyResults
from agents.studies.policies.tables import ranking

KIND_COLOURS = {"baseline": "#5f6b7a", "bound": "#b9770e", "learned": "#1b4f72"}
LINE_COLOURS = (
    "#1b4f72", "#c1272d", "#5d8233", "#7d5ba6", "#b9770e", "#009e73", "#cc79a7", "#333333",
    "#56b4e9",
)  # fmt: skip
LINEAR_UP_TO = 1e5
"""Seconds of training up to which learning curves are drawn to a linear scale."""
SINCE = range(-240, 361, BIN)
"""Edges of the bins of time from the start of the incident that are drawn [s]."""


def draw_ranking(results: PolicyResults) -> Figure:
    """Draw the errors of all policies in the primary cell, a panel for each error."""
    ranks = ranking(results, PRIMARY)
    figure = make_figure(10.4, 1.5 + 0.3 * len(ranks))
    axes = figure.subplots(1, len(METRICS), sharey=True)
    places = np.arange(len(ranks))[::-1]
    for axis, (metric, (name, unit)) in zip(axes, METRICS.items(), strict=True):
        for place, rank in zip(places, ranks, strict=True):
            interval = results.interval(mean, rank.errors[metric])
            draw_dot(axis, interval, place, KIND_COLOURS[rank.kind], rank.kind)
        axis.set_xlabel(f"{name} error [{unit}]")
    axes[0].set_yticks(places, [rank.label for rank in ranks])
    return finish_figure(figure, margin=0.12)


def draw_cells(results: PolicyResults) -> Figure:
    """Draw how far learned policies lie below both references, a row for each cell."""
    rows = [
        (f"{cell.name}: {learner.label}", cell.name, learner)
        for cell in results.design.cells
        for learner in results.chosen(cell.name)
    ]
    figure = make_figure(9.0, 1.8 + 0.45 * max(len(rows), 1))
    axis = figure.subplots()
    places = np.arange(len(rows))[::-1]
    for place, (_, cell, learner) in zip(places, rows, strict=True):
        names = (results.choice(cell).baseline, REFERENCE)
        labels = ("below the best baseline", "below the paper's schedule")
        for k, (name, label) in enumerate(zip(names, labels, strict=True)):
            below = results.below(results.learned(learner), results.schedule(cell, name))
            draw_dot(axis, below, place + 0.12 - 0.24 * k, LINE_COLOURS[k], label)
    axis.axvline(0.0, color="#333333", linewidth=1.0)
    axis.set_yticks(places, [label for label, _, _ in rows])
    axis.set_xlabel("error below the reference [%]")
    return finish_figure(figure, margin=0.12)


def draw_curves(results: PolicyResults) -> Figure:
    """Draw the learning curves, their mean over training seeds, and the schedules' errors."""
    figure = make_figure(7.6, 4.6)
    axis = figure.subplots()
    recipes = dict.fromkeys(curve.recipe for curve in results.curves)
    for colour, recipe in zip(cycle(LINE_COLOURS), recipes, strict=False):
        curves = [curve for curve in results.curves if curve.recipe == recipe]
        for curve in curves:
            axis.plot(curve.steps, curve.errors, color=colour, linewidth=0.8, alpha=0.5)
        common = sorted(set.intersection(*(set(curve.steps) for curve in curves)))
        means = [
            np.mean([curve.errors[curve.steps.index(step)] for curve in curves]) for step in common
        ]
        label = f"{recipe}, mean of {len(curves)}" if len(curves) > 1 else recipe
        # A regression alone is one point.
        axis.plot(common, means, "o-", ms=3.5, color=colour, linewidth=2.0, label=label)
    choice = results.choice(PRIMARY)
    for name, line in ((choice.baseline, "--"), (REFERENCE, ":")):
        axis.axhline(1000.0 * choice.errors[name], color="#333333", linestyle=line, label=name)
    # Some recipes simulate ten times as long as others.
    axis.set_xscale("symlog", linthresh=LINEAR_UP_TO)
    axis.set_xlabel("seconds simulated in training")
    axis.set_ylabel("error on validation traffic × 1000")
    return finish_figure(figure, margin=0.12)


def draw_queries(results: PolicyResults) -> Figure:
    """Draw where and when policies of the primary cell query."""
    figure = make_figure(11.0, 7.0)
    axes = figure.subplots(2, 3)
    drawn = _drawn(results).items()
    for colour, (label, episodes) in zip(cycle(LINE_COLOURS), drawn, strict=False):
        shares = by_segment(episodes)
        axes[0, 0].plot(1 + np.arange(len(shares)), shares, "o-", ms=3, color=colour, label=label)
        for axis, phase in zip(axes[1], PHASES, strict=True):
            axis.plot(*by_offset(episodes, phase), "o-", ms=3, color=colour)
        axes[0, 1].plot(*near_since_start(episodes, SINCE), color=colour)
    axes[0, 0].set_xlabel("segment")
    axes[0, 0].set_ylabel("share of seconds in which it is queried")
    axes[0, 1].set_xlabel("time since the start of the incident [s]")
    axes[0, 1].set_ylabel(f"share of queries\nwithin {NEAR} segments of it")
    for axis, phase in zip(axes[1], PHASES, strict=True):
        axis.set_xlabel(f"segments downstream of the incident, {phase} it")
        axis.axvline(0.0, color="#333333", linewidth=0.8)
    axes[1, 0].set_ylabel("share of seconds in which it is queried")
    axes[0, 2].axis("off")
    for axis in (axes[0, 0], *axes[1]):
        axis.set_ylim(bottom=0.0)
    return finish_figure(figure, margin=0.12)


def _drawn(results: PolicyResults) -> dict[str, list[QueryCounts]]:
    """Return the episodes of both references, the error oracle, and the frozen recipes."""
    manifest, seeds = results.manifest, results.design.test_seeds
    named: dict[str, list[Entry]] = {
        name: [Entry(PRIMARY, "baseline", name)] for name in dict.fromkeys(results.references)
    }
    for name in manifest.bounds[PRIMARY][:1]:
        named[name] = [Entry(PRIMARY, "bound", name)]
    for learner in manifest.learners(results.design.cell(PRIMARY)):
        entries = [learner.entry(seed) for seed in manifest.runs(learner)]
        if all((entry, seeds[0]) in results.queries for entry in entries):
            named[learner.label] = entries
    return {
        label: [results.queries[entry, seed] for entry in entries for seed in seeds]
        for label, entries in named.items()
    }
