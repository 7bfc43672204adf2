"""Figures of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from agents.evaluation.statistics import Interval
from dptse_env.rendering import DENSITY_MAP, QUERY_COLOUR, History

COLOURS = ("#1b4f72", "#c1272d", "#5d8233", "#7d5ba6", "#b9770e")


def save_ladder(
    path: Path,
    rows: Sequence[str],
    series: Mapping[str, Mapping[str, tuple[Interval, Interval]]],
    title: str,
) -> None:
    """Save the errors of every policy as dots with 95 % intervals, density beside speed.

    Args:
        path: Where to save the PNG.
        rows: Policies, from top to bottom.
        series: By estimator, then by policy: (density [veh/km], speed [km/h]) intervals.
        title: Title of the figure.
    """
    figure = Figure(figsize=(8.4, 1.6 + 0.42 * len(rows)), dpi=150, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(rows))[::-1]
    for metric, axis in enumerate(axes):
        for k, (name, intervals) in enumerate(series.items()):
            shift = ((len(series) - 1) / 2 - k) * 0.3
            for place, row in zip(places, rows, strict=True):
                label = name if row == rows[0] else None
                _dot(axis, intervals[row][metric], place + shift, COLOURS[k % len(COLOURS)], label)
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(FixedLocator([1, 2, 5, 10, 20, 50, 100, 200]))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.xaxis.set_major_formatter("{x:g}")
        axis.margins(x=0.12)
        axis.set_xlabel(("density RMSE [veh/km]", "speed RMSE [km/h]")[metric])
        axis.grid(axis="x", color="#d9dde3", linewidth=0.8)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_yticks(places, rows)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower right", ncols=len(labels), frameon=False, fontsize=8
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    save(figure, path)


def _dot(axis: Any, interval: Interval, place: float, colour: str, label: str | None) -> None:
    """Draw one mean with its interval and its value beside it."""
    spread = [[interval.mean - interval.low], [interval.high - interval.mean]]
    style = {"fmt": "o", "markersize": 4, "capsize": 2.5, "linewidth": 1.2}
    axis.errorbar([interval.mean], [place], xerr=spread, color=colour, label=label, **style)
    axis.annotate(
        f"{interval.mean:.1f}",
        (interval.high, place),
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        fontsize=7,
        color=colour,
    )


def save_space_time(path: Path, histories: Mapping[str, History], title: str) -> None:
    """Save the true density over the estimate and the queries of each policy.

    Args:
        path: Where to save the PNG.
        histories: By policy, all over the same traffic.
        title: Title of the figure.
    """
    first = next(iter(histories.values()))
    panels = [("true density", np.array(first.truth).T, False)]
    for name, history in histories.items():
        rmse = float(np.sqrt(np.mean(np.square(history.rmse[60:]))))
        label = f"{name}: estimate, RMSE {rmse:.1f} veh/km"
        panels.append((label, np.array(history.estimate).T, False))
        panels.append((f"{name}: queried", np.array(history.queried).T, True))
    ratios = [1.6 if flags else 2.4 for _, _, flags in panels]
    figure = Figure(figsize=(8.4, 0.5 * sum(ratios) + 1.0), dpi=150, layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, gridspec_kw={"height_ratios": ratios})
    for axis, (name, values, flags) in zip(axes, panels, strict=True):
        extent = (-0.5, values.shape[1] - 0.5, 0.0, len(values) * first.segment_length)
        limits = {"vmin": 0, "vmax": 1 if flags else first.density_scale}
        image = axis.imshow(
            values,
            origin="lower",
            aspect="auto",
            extent=extent,
            cmap="Greys" if flags else DENSITY_MAP,
            **limits,
        )
        if not flags:
            density = image
        axis.set_title(name, loc="left", fontsize=9, pad=3, color=QUERY_COLOUR)
        axis.set_ylabel("road [km]", fontsize=8)
        axis.tick_params(labelsize=8)
    axes[-1].set_xlabel("time [s]", fontsize=8)
    bar = figure.colorbar(density, ax=axes.tolist(), fraction=0.025, pad=0.02, extend="max")
    bar.set_label("density [veh/km]", fontsize=8)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Save a figure as PNG, without pyplot and its global state."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(str(path))
