"""The figures of results 1, 3, 4 and 5, in the form of the paper's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

from agents.evaluation.figures import save
from agents.evaluation.statistics import Interval, geometric_mean_interval, mean_interval
from agents.studies.paper.measures import DENSITY, LABELS, SPEED, UNITS
from agents.studies.paper.plan import ESTIMATORS, SETTINGS, Setting
from agents.studies.paper.results import Measured
from agents.studies.paper.timing import PAPER_SECONDS

COLOURS = {
    "ekf": "#0072b2",
    "ukf": "#d55e00",
    "enkf": "#009e73",
    "mhe": "#cc79a7",
    "random_walk": "#666666",
    "open_loop": "#000000",
}
MARKERS = {"ekf": "o", "ukf": "s", "enkf": "^", "mhe": "D", "random_walk": "v", "open_loop": ""}
STYLES = {"random_walk": "--", "open_loop": ":"}
AXES = {"bandwidth": "number of CV segments", "epsilon": "ε", "delta": "δ"}
OFF_SCALE = 1.3
"""An open loop this many times above everything else is named at the edge instead of drawn."""
TICKS = (10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300)


@dataclass(frozen=True)
class Look:
    """How a figure of sweeps is laid out.

    Attributes:
        field: The sweep.
        metrics: One block of rows each.
        columns: Panels side by side.
        log: Whether both axes are logarithmic; otherwise neither is.
        log_places: Whether the horizontal one is, alone.
    """

    field: str
    metrics: tuple[str, ...]
    columns: int
    log: bool = False
    log_places: bool = False


LOOKS = {
    "fig1_cv_segments.png": Look("bandwidth", (DENSITY, SPEED), 4),
    "fig3_epsilon.png": Look("epsilon", (DENSITY,), 2, log=True),
    "fig4_delta.png": Look("delta", (DENSITY,), 2, log_places=True),
}
"""Figures of results 1, 3 and 4 by file."""


def save_sweeps(path: Path, measured: Measured, look: Look, title: str) -> None:
    """Save error against the swept quantity, one panel for each metric and setting.

    Curves are means over traffic seeds with 95 % intervals as bars.
    """
    panels = [(metric, setting) for metric in look.metrics for setting in SETTINGS]
    n_rows = len(panels) // look.columns
    figure = Figure(figsize=(3.5 * look.columns + 0.4, 3.1 * n_rows + 1.0), dpi=140)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(n_rows, look.columns, squeeze=False)
    for k, (axis, (metric, setting)) in enumerate(zip(axes.flat, panels, strict=True)):
        _sweep_panel(axis, measured, look, metric, setting)
        if k % look.columns == 0:
            name = {DENSITY: "density", SPEED: "speed"}[metric]
            axis.set_ylabel(f"{name} RMSE [{UNITS[metric]}]")
        if k >= len(panels) - look.columns:
            axis.set_xlabel(AXES[look.field])
    _legend(figure, measured.design.all_estimators)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    save(figure, path)


def _sweep_panel(axis: Any, measured: Measured, look: Look, metric: str, setting: Setting) -> None:
    places = np.array(measured.design.sweeps[look.field].values)
    highest = 0.0
    for shift, name in enumerate(measured.design.all_estimators):
        if name == "open_loop":
            continue
        curve = measured.curve(look.field, name, setting, metric)
        intervals = [mean_interval(values) for values in curve]
        highest = max(highest, *(interval.high for interval in intervals))
        _curve(axis, _beside(places, shift, look), intervals, name)
    axis.set_title(str(setting), fontsize=9, loc="left")
    _scales(axis, look, places)
    alone = mean_interval(measured.base("open_loop", setting, metric))
    _open_loop(axis, alone, highest, UNITS[metric], drawn=look.log)
    axis.grid(color="#e3e6ea", linewidth=0.7)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8)


def _beside(places: Any, shift: int, look: Look) -> Any:
    """Move the points of each curve a little aside, so that bars do not hide one another."""
    part = 0.01 * (shift - 2)  # of the axis
    if look.log or look.log_places:
        return places * (places[-1] / places[0]) ** part
    return places + part * (places[-1] - places[0])


def _curve(axis: Any, places: Any, intervals: Sequence[Interval], name: str) -> None:
    means = np.array([interval.mean for interval in intervals])
    spread = np.array([[own.mean - own.low, own.high - own.mean] for own in intervals]).T
    axis.errorbar(
        places,
        means,
        yerr=spread,
        color=COLOURS[name],
        marker=MARKERS[name],
        linestyle=STYLES.get(name, "-"),
        markersize=4,
        linewidth=1.2,
        capsize=2,
    )


def _scales(axis: Any, look: Look, places: Any) -> None:
    if look.log or look.log_places:
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(FixedLocator(list(places)))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    else:
        axis.set_xticks(places)
    if look.log:
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(FixedLocator(TICKS))
        axis.yaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))


def _open_loop(axis: Any, alone: Interval, highest: float, unit: str, drawn: bool) -> None:
    """Draw the open loop as a line, or name its value where the line would squeeze the rest."""
    if drawn or alone.mean < OFF_SCALE * highest:
        axis.axhline(alone.mean, color=COLOURS["open_loop"], linestyle=":", linewidth=1.4)
        axis.axhspan(alone.low, alone.high, color=COLOURS["open_loop"], alpha=0.12, linewidth=0)
        return
    axis.annotate(
        f"open loop {alone.mean:.1f} ± {alone.half_width:.1f} {unit}, off the scale ↑",
        (0.98, 0.985),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=7.5,
    )
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.08 * (high - low))  # room for the words


def _legend(figure: Figure, names: Sequence[str]) -> None:
    handles = [
        Line2D(
            [],
            [],
            color=COLOURS[name],
            marker=MARKERS[name],
            linestyle=STYLES.get(name, "-"),
            markersize=4,
            label=LABELS[name],
        )
        for name in names
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(names), frameon=False)


def save_times(path: Path, measured: Measured, title: str) -> None:
    """Save the time of a step beside the paper's, and both relative to the EKF's."""
    figure = Figure(figsize=(9.6, 3.9), dpi=140)
    figure.set_layout_engine("constrained")
    names = measured.design.all_estimators
    places = np.arange(len(names))[::-1]
    for axis, relative in zip(figure.subplots(1, 2, sharey=True), (False, True), strict=True):
        if relative and "ekf" not in names:
            axis.set_visible(False)
            continue
        _times(axis, measured, places, relative)
        axis.set_yticks(places, [LABELS[name] for name in names])
        axis.set_xscale("log")
        axis.set_xlabel("time of a step / EKF's" if relative else "time of a step [ms]")
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(axis="x", which="both", color="#e3e6ea", linewidth=0.7)
        axis.set_axisbelow(True)
        axis.margins(x=0.15)
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    save(figure, path)


def _times(axis: Any, measured: Measured, places: Any, relative: bool) -> None:
    names = measured.design.all_estimators
    shades = ("#0072b2", "#56b4e9", "#d55e00", "#e69f00")
    for k, setting in enumerate(SETTINGS):
        reference = measured.seconds("ekf", setting) if relative else 1e-3
        for place, name in zip(places, names, strict=True):
            own = geometric_mean_interval(measured.seconds(name, setting) / reference)
            axis.errorbar(
                [own.mean],
                [place + 0.24 - 0.16 * k],
                xerr=[[own.mean - own.low], [own.high - own.mean]],
                fmt="o",
                markersize=4,
                capsize=2,
                color=shades[k],
                label=f"here, {setting}" if name == names[0] else None,
            )
    scale = PAPER_SECONDS["ekf"] if relative else 1e-3
    told = [(place, name) for place, name in zip(places, names, strict=True) if name in ESTIMATORS]
    axis.plot(
        [PAPER_SECONDS[name] / scale for _, name in told],
        [place for place, _ in told],
        linestyle="none",
        marker="x",
        color="#000000",
        label="the paper",
    )
