"""The figures of the study."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from agents.evaluation.figures import save
from agents.evaluation.statistics import FloatArray, Interval, mean
from agents.studies.policies.plan import PRIMARY, REFERENCE, Entry
from agents.studies.policies.queries import BIN, NEAR, PHASES, Asked
from agents.studies.policies.results import METRICS, Measured
from agents.studies.policies.tables import ladder

COLOURS = {"baseline": "#5f6b7a", "bound": "#b9770e", "learned": "#1b4f72"}
CURVES = (
    "#1b4f72", "#c1272d", "#5d8233", "#7d5ba6", "#b9770e", "#009e73", "#cc79a7", "#333333",
    "#56b4e9",
)  # fmt: skip
FEW = 1e5
"""Seconds of training up to which learning curves are drawn to a linear scale."""
SINCE = range(-240, 361, BIN)
"""Edges of the stretches of time from the start of the incident that are drawn [s]."""


def save_ladder(path: Path, measured: Measured, title: str) -> None:
    """Save the errors of everyone in the primary cell, a panel for each error."""
    rungs = ladder(measured, PRIMARY)
    figure = _figure((10.4, 1.5 + 0.3 * len(rungs)))
    axes = figure.subplots(1, len(METRICS), sharey=True)
    places = np.arange(len(rungs))[::-1]
    for axis, (metric, (name, unit)) in zip(axes, METRICS.items(), strict=True):
        for place, rung in zip(places, rungs, strict=True):
            interval = measured.interval(mean, rung.errors[metric])
            _dot(axis, interval, place, COLOURS[rung.kind], rung.kind)
        axis.set_xlabel(f"{name} error [{unit}]")
    axes[0].set_yticks(places, [rung.label for rung in rungs])
    _finish(figure, axes, title, path)


def save_cells(path: Path, measured: Measured, title: str) -> None:
    """Save by how much learned policies lie below both references, a row for each cell."""
    rows = [
        (f"{cell.name}: {learner.label}", cell.name, learner)
        for cell in measured.design.cells
        for learner in measured.chosen(cell.name)
    ]
    figure = _figure((9.0, 1.8 + 0.45 * max(len(rows), 1)))
    axis = figure.subplots()
    places = np.arange(len(rows))[::-1]
    for place, (_, cell, learner) in zip(places, rows, strict=True):
        names = (measured.choice(cell).baseline, REFERENCE)
        labels = ("below the best baseline", "below the paper's schedule")
        for k, (name, label) in enumerate(zip(names, labels, strict=True)):
            below = measured.below(measured.learned(learner), measured.schedule(cell, name))
            _dot(axis, below, place + 0.12 - 0.24 * k, CURVES[k], label)
    axis.axvline(0.0, color="#333333", linewidth=1.0)
    axis.set_yticks(places, [label for label, _, _ in rows])
    axis.set_xlabel("error below the reference [%]")
    _finish(figure, [axis], title, path)


def save_curves(path: Path, measured: Measured, title: str) -> None:
    """Save the learning curves, their mean over training seeds, and the schedules' marks."""
    figure = _figure((7.6, 4.6))
    axis = figure.subplots()
    recipes = dict.fromkeys(curve.recipe for curve in measured.curves)
    for colour, recipe in zip(cycle(CURVES), recipes, strict=False):
        own = [curve for curve in measured.curves if curve.recipe == recipe]
        for curve in own:
            axis.plot(curve.steps, curve.errors, color=colour, linewidth=0.8, alpha=0.5)
        common = sorted(set.intersection(*(set(curve.steps) for curve in own)))
        means = [
            np.mean([curve.errors[curve.steps.index(step)] for curve in own]) for step in common
        ]
        label = f"{recipe}, mean of {len(own)}" if len(own) > 1 else recipe
        # A regression alone is one point.
        axis.plot(common, means, "o-", ms=3.5, color=colour, linewidth=2.0, label=label)
    choice = measured.choice(PRIMARY)
    for name, line in ((choice.baseline, "--"), (REFERENCE, ":")):
        axis.axhline(1000.0 * choice.errors[name], color="#333333", linestyle=line, label=name)
    axis.set_xscale("symlog", linthresh=FEW)  # some recipes simulate ten times what others do
    axis.set_xlabel("seconds simulated in training")
    axis.set_ylabel("error on validation traffic × 1000")
    _finish(figure, [axis], title, path)


def save_asked(path: Path, measured: Measured, title: str) -> None:
    """Save where and when policies of the primary cell ask."""
    figure = _figure((11.0, 7.0))
    axes = figure.subplots(2, 3)
    for colour, (label, own) in zip(cycle(CURVES), _drawn(measured), strict=False):
        axes[0, 0].plot(1 + np.arange(len(by_segment(own))), by_segment(own), "o-", ms=3,
                        color=colour, label=label)  # fmt: skip
        for axis, phase in zip(axes[1], PHASES, strict=True):
            offsets, shares = by_offset(own, phase)
            axis.plot(offsets, shares, "o-", ms=3, color=colour)
        axes[0, 1].plot(*near_since_start(own), color=colour)
    axes[0, 0].set_xlabel("segment")
    axes[0, 0].set_ylabel("share of seconds in which it is asked")
    axes[0, 1].set_xlabel("time since the start of the incident [s]")
    axes[0, 1].set_ylabel(f"share of queries\nwithin {NEAR} segments of it")
    for axis, phase in zip(axes[1], PHASES, strict=True):
        axis.set_xlabel(f"segments downstream of the incident, {phase} it")
        axis.axvline(0.0, color="#333333", linewidth=0.8)
    axes[1, 0].set_ylabel("share of seconds in which it is asked")
    axes[0, 2].axis("off")
    for axis in (axes[0, 0], *axes[1]):
        axis.set_ylim(bottom=0.0)
    _finish(figure, [axes[0, 0]], title, path)


def _drawn(measured: Measured) -> list[tuple[str, list[Asked]]]:
    """Return whom to draw: both references, the error oracle, and the recipes that were frozen."""
    manifest = measured.manifest
    named: dict[str, list[Entry]] = {
        name: [Entry(PRIMARY, "baseline", name)] for name in dict.fromkeys(measured.references)
    }
    for name in manifest.bounds[PRIMARY][:1]:
        named[name] = [Entry(PRIMARY, "bound", name)]
    for learner in manifest.learners(measured.design.cell(PRIMARY)):
        entries = [learner.entry(seed) for seed in manifest.runs(learner)]
        if all((entry, measured.design.test_seeds[0]) in measured.asked for entry in entries):
            named[learner.label] = entries
    return [
        (
            label,
            [measured.asked[entry, seed] for entry in own for seed in measured.design.test_seeds],
        )
        for label, own in named.items()
    ]


def by_segment(own: Sequence[Asked]) -> FloatArray:
    """Return the share of seconds in which each segment is asked, shape (n_mainline,)."""
    counts = sum(one.counts(phase) for one in own for phase in PHASES)
    share: FloatArray = np.asarray(counts) / sum(one.counts("seconds").sum() for one in own)
    return share


def by_offset(own: Sequence[Asked], phase: str) -> tuple[FloatArray, FloatArray]:
    """Return offsets from the incident's segment, and the share of seconds each is asked.

    Only seconds count in which a segment lies there. Episodes without an incident are left out.
    """
    placed = [one for one in own if one.incident >= 0]
    n = len(own[0].counts(phase))
    asked, seconds = np.zeros(2 * n - 1), np.zeros(2 * n - 1)
    for one in placed:
        window = slice(n - 1 - one.incident, 2 * n - 1 - one.incident)
        asked[window] += one.counts(phase)
        seconds[window] += one.counts("seconds")[PHASES.index(phase)]
    seen = seconds > 0
    return np.arange(1 - n, n)[seen].astype(np.float64), asked[seen] / seconds[seen]


def near_since_start(own: Sequence[Asked]) -> tuple[FloatArray, FloatArray]:
    """Return seconds since the incident's start, and the share of queries near it.

    Stretches of time are sorted by where their middle lies.
    """
    edges = np.array(SINCE, dtype=np.float64)
    near, queries = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)
    for one in own:
        if one.incident < 0:
            continue
        n_seconds = int(one.counts("seconds").sum())
        counts = one.counts("near")[: n_seconds // BIN]  # without a stretch that is cut off
        middle = BIN * (np.arange(len(counts)) + 0.5) - one.start
        place = np.digitize(middle, edges) - 1
        inside = (place >= 0) & (place < len(near))
        total = sum(one.counts(phase).sum() for phase in PHASES)
        np.add.at(near, place[inside], counts[inside])
        np.add.at(queries, place[inside], total / n_seconds * BIN)
    seen = queries > 0
    return (edges[:-1] + BIN / 2)[seen], near[seen] / queries[seen]


def _figure(size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, dpi=140)
    figure.set_layout_engine("constrained")
    return figure


def _dot(axis: Any, interval: Interval, place: float, colour: str, label: str) -> None:
    """Draw a mean with its interval and its value beside it."""
    spread = [[interval.mean - interval.low], [interval.high - interval.mean]]
    style = {"fmt": "o", "markersize": 4, "capsize": 2.5, "linewidth": 1.2}
    axis.errorbar([interval.mean], [place], xerr=spread, color=colour, label=label, **style)
    beside = {"xytext": (5, 0), "textcoords": "offset points", "va": "center", "fontsize": 7}
    axis.annotate(f"{interval.mean:.1f}", (interval.high, place), color=colour, **beside)


def _finish(figure: Figure, axes: Iterable[Any], title: str, path: Path) -> None:
    """Name every colour once below the panels, and save."""
    named: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    for axis in figure.axes:
        axis.grid(color="#e3e6ea", linewidth=0.7)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
        axis.margins(x=0.12)
    if named:
        figure.legend(
            list(named.values()), list(named), loc="outside lower center",
            ncols=min(len(named), 5), frameon=False, fontsize=8,
        )  # fmt: skip
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    save(figure, path)
