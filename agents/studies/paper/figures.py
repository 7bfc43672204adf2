"""Figures of the paper's five results, in the form of the paper's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from agents.evaluation.episodes import EpisodeScore, watch_episode
from agents.experiments.cells import DENSITY, METRICS, SPEED
from agents.experiments.runner import make_env
from agents.figures import (
    ERROR_TICKS,
    ESTIMATOR_LOOKS,
    LABELS,
    RoadMap,
    add_frame,
    add_legend,
    draw_curve,
    draw_level,
    draw_maps,
    estimate_map,
    make_figure,
    set_log_ticks,
    shifted,
    spread,
)
from agents.statistics import Interval, geometric_mean_interval, mean_interval
from agents.studies.paper.plan import PAPER_ESTIMATORS, SETTINGS, PaperCell, PaperDesign, Setting
from agents.studies.paper.results import PaperResults
from agents.studies.paper.timing import PAPER_SECONDS
from dptse_env.rendering import History
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Records

AXES = {"bandwidth": "number of CV segments", "epsilon": "ε", "delta": "δ"}
OFF_SCALE = 1.3
"""An open loop this many times above everything else is named at the edge instead of drawn."""


@dataclass(frozen=True)
class SweepLayout:
    """Layout of a figure of a sweep.

    Attributes:
        metrics: One block of rows each.
        log: Whether the vertical axis is logarithmic.
        log_places: Whether the horizontal axis is.
    """

    field: str
    metrics: tuple[str, ...]
    columns: int
    log: bool = False
    log_places: bool = False


LAYOUTS = {
    "fig1_cv_segments.png": SweepLayout("bandwidth", (DENSITY, SPEED), 4),
    "fig3_epsilon.png": SweepLayout("epsilon", (DENSITY,), 2, log=True, log_places=True),
    "fig4_delta.png": SweepLayout("delta", (DENSITY,), 2, log_places=True),
}
"""Layouts of the figures of results 1, 3 and 4 by file."""


def draw_sweeps(results: PaperResults, layout: SweepLayout) -> Figure:
    """Draw error against the swept quantity, one panel for each metric and setting.

    Curves are means over traffic seeds with 95 % intervals as bars.
    """
    panels = [(metric, setting) for metric in layout.metrics for setting in SETTINGS]
    n_rows = len(panels) // layout.columns
    figure = make_figure(3.5 * layout.columns + 0.4, 3.1 * n_rows + 1.0)
    axes = figure.subplots(n_rows, layout.columns, squeeze=False)
    for k, (axis, (metric, setting)) in enumerate(zip(axes.flat, panels, strict=True)):
        _sweep_panel(axis, results, layout, metric, setting)
        if k % layout.columns == 0:
            name, unit = METRICS[metric]
            axis.set_ylabel(f"{name} RMSE [{unit}]")
        if k >= len(panels) - layout.columns:
            axis.set_xlabel(AXES[layout.field])
    names = results.design.all_estimators
    handles = [_legend_line(name) for name in names]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(names), frameon=False)
    return figure


def _sweep_panel(
    axis: Axes, results: PaperResults, layout: SweepLayout, metric: str, setting: Setting
) -> None:
    places = results.design.sweeps[layout.field]
    highest = 0.0
    for k, name in enumerate(results.design.all_estimators):
        if name != "open_loop":
            curve = results.curve(layout.field, name, setting, metric)
            intervals = [mean_interval(values) for values in curve]
            highest = max(highest, *(interval.high for interval in intervals))
            apart = shifted(places, 0.01 * (k - 2), layout.log_places)
            draw_curve(axis, apart, intervals, ESTIMATOR_LOOKS[name])
    axis.set_title(str(setting), fontsize=9, loc="left")
    if layout.log_places:
        axis.set_xscale("log")
        set_log_ticks(axis.xaxis, places)
    else:
        axis.set_xticks(places)
    if layout.log:
        axis.set_yscale("log")
        set_log_ticks(axis.yaxis, ERROR_TICKS)
    alone = mean_interval(results.base("open_loop", setting, metric))
    draw_open_loop(axis, alone, highest, METRICS[metric][1], always=layout.log)
    add_frame(axis)


def draw_open_loop(
    axis: Axes, alone: Interval, highest: float, unit: str, always: bool = False
) -> None:
    """Draw the open loop as a line, or write its value where the line would squeeze the rest.

    Args:
        axis: Panel with the other curves.
        alone: Error of the open loop.
        highest: Largest error of the other curves.
        unit: Unit of the errors.
        always: Whether to draw the line wherever it lies.
    """
    if always or alone.mean < OFF_SCALE * highest:
        draw_level(axis, alone)
        return
    axis.annotate(
        f"open loop {alone.mean:.1f} ± {alone.half_width:.1f} {unit}, off the scale ↑",
        (0.98, 0.985), xycoords="axes fraction", ha="right", va="top", fontsize=7.5,
    )  # fmt: skip
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.08 * (high - low))  # space for the text


def _legend_line(name: str) -> Line2D:
    colour, marker, line = ESTIMATOR_LOOKS[name]
    return Line2D(
        [], [], color=colour, marker=marker, linestyle=line, markersize=4, label=LABELS[name]
    )


def draw_times(results: PaperResults) -> Figure:
    """Draw the time of a step beside the paper's, and both relative to the EKF's."""
    figure = make_figure(9.6, 3.9)
    names = results.design.all_estimators
    places = np.arange(len(names))[::-1]
    axes = figure.subplots(1, 2, sharey=True)
    for axis, relative in zip(axes, (False, True), strict=True):
        if relative and "ekf" not in names:
            axis.set_visible(False)
            continue
        _time_panel(axis, results, places, relative)
        axis.set_yticks(places, [LABELS[name] for name in names])
        axis.set_xscale("log")
        axis.set_xlabel("time of a step / EKF's" if relative else "time of a step [ms]")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        add_frame(axis, "x")
        axis.margins(x=0.15)
    add_legend(figure, axes[:1], columns=3)
    return figure


def _time_panel(axis: Axes, results: PaperResults, places: Any, relative: bool) -> None:
    names = results.design.all_estimators
    shades = ("#0072b2", "#56b4e9", "#d55e00", "#e69f00")
    for k, setting in enumerate(SETTINGS):
        reference = results.seconds("ekf", setting) if relative else 1e-3
        times = [
            geometric_mean_interval(results.seconds(name, setting) / reference) for name in names
        ]
        axis.errorbar(
            [time.mean for time in times], places + 0.24 - 0.16 * k, xerr=spread(times),
            fmt="o", markersize=4, capsize=2, color=shades[k], label=f"here, {setting}",
        )  # fmt: skip
    scale = PAPER_SECONDS["ekf"] if relative else 1e-3
    published = [k for k, name in enumerate(names) if name in PAPER_ESTIMATORS]
    axis.plot(
        [PAPER_SECONDS[names[k]] / scale for k in published], [places[k] for k in published],
        linestyle="none", marker="x", color="#000000", label="the paper",
    )  # fmt: skip


Watched = dict[PaperCell, tuple[EpisodeScore, History]]


def watch_pictures(design: PaperDesign, records: Records) -> Watched:
    """Run the episodes of result 2: the first traffic seed, every estimator and setting."""
    seed, watched = design.traffic_seeds[0], {}
    names = design.all_estimators
    cells = [design.picture(name, setting) for setting in SETTINGS for name in names]
    for cell in dict.fromkeys(cells):
        env = make_env(design.env, design.keywords(cell), design.traffic_seeds, records)
        schedule = make_schedule(design.schedule, env)
        watched[cell] = watch_episode(env, schedule, traffic_seed=seed, seed=seed)
    return watched


def draw_pictures(design: PaperDesign, watched: Watched) -> Figure:
    """Draw maps of density: truth on top, then each estimator; a column for each setting."""
    columns = []
    for setting in SETTINGS:
        episodes = [watched[design.picture(name, setting)] for name in design.all_estimators]
        maps = [RoadMap(f"{setting}\ntruth", episodes[0][1].truth, episodes[0][1])]
        for name, (score, history) in zip(design.all_estimators, episodes, strict=True):
            maps.append(estimate_map(history, score.rmse_density, LABELS[name]))
        columns.append(maps)
    return draw_maps(columns, width=14.0)
