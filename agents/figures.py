"""Figures: their style, curves with intervals, errors of policies, and maps of space and time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from textwrap import fill
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, NullLocator
from numpy.typing import ArrayLike, NDArray

from agents.statistics import Interval
from agents.tables import UnmeasuredError
from dptse_env.rendering import DENSITY_MAP, History
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.files import replacing

INK = "#757a82"
"""A grey that is read on white and on dark pages: figures are transparent."""
COLOURS = ("#1a80c4", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", INK)
"""Okabe and Ito's, which the colour-blind can tell apart, with a lighter blue, and the grey."""
SHADES = LinearSegmentedColormap.from_list("shades", [(INK, 0.0), (INK, 1.0)])
"""From nothing to the grey."""
WIDTH = 4.6
"""Largest width of a figure [inches]: its texts of 8 points are read on a phone."""
ERROR_TICKS = (1, 1.5, 2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300, 500, 700, 1000)


def make_figure(width: float, height: float, dpi: int = 160) -> Figure:
    """Return an empty figure [inches] that lays out its axes without overlaps.

    One that is too wide is made narrower, and up to a fifth lower.
    """
    share = min(WIDTH / width, 1.0)
    size = (share * width, max(share, 0.8) * height)
    return Figure(figsize=size, dpi=dpi, layout="constrained")


def save_figure(figure: Figure, path: Path, title: str) -> None:
    """Give a figure its title and save it as PNG, without pyplot and its global state.

    The PNG is transparent, and what is black turns grey.
    """
    folded = fill(title, int(13 * figure.get_figwidth()))
    figure.suptitle(folded, x=0.01, ha="left", fontsize=10)
    turn_grey(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", transparent=True)


def turn_grey(figure: Figure) -> None:
    """Give black texts and lines the colour that is read on dark pages, too."""
    figure.draw_without_rendering()  # makes the ticks
    drawn: Any = figure.findobj(lambda each: isinstance(each, Text | Line2D))
    for artist in drawn:
        if to_hex(artist.get_color()) == "#000000":
            artist.set_color(INK)
    for axis in figure.axes:
        axis.tick_params(which="both", color=INK)
        axis.spines[:].set_color(INK)


def save_measured(path: Path, title: str, draw: Callable[..., Figure], *arguments: Any) -> None:
    """Draw and save a figure if all that it shows was measured; an old one goes if not."""
    try:
        save_figure(draw(*arguments), path, title)
    except UnmeasuredError:
        path.unlink(missing_ok=True)


def add_frame(axis: Axes, lines: Literal["both", "x", "y"] = "both") -> None:
    """Give axes a grid behind their curves and no lines above and to the right."""
    axis.grid(axis=lines, color=INK, alpha=0.25, linewidth=0.7)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8)


def finish_figure(figure: Figure) -> Figure:
    """Frame all panels, and name their curves below them."""
    for axis in figure.axes:
        add_frame(axis)
    add_legend(figure, figure.axes)
    return figure


def add_legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """Name each label of some axes once below all panels, in as many columns as fit."""
    named: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    if named:
        columns = int(16 * figure.get_figwidth() / (max(map(len, named)) + 6))
        figure.legend(
            list(named.values()),
            list(named),
            loc="outside lower center",
            ncols=max(1, min(len(named), columns)),
            frameon=False,
            fontsize=8,
        )


def set_log(axis: Axes, x: Sequence[float] = (), y: Sequence[float] = ()) -> None:
    """Make an axis that is given ticks logarithmic, with plain numbers there and nothing between.

    Those for errors are `ERROR_TICKS`.
    """
    both = (axis.set_xscale, axis.xaxis, x), (axis.set_yscale, axis.yaxis, y)
    for set_scale, side, ticks in both:
        if ticks:
            set_scale("log")
            side.set_major_locator(FixedLocator(list(ticks)))
            side.set_minor_locator(NullLocator())
            side.set_major_formatter("{x:g}")


def spread(intervals: Sequence[Interval]) -> FloatArray:
    """Return the lengths of error bars below and above the means, shape (2, n)."""
    return np.array([[each.mean - each.low, each.high - each.mean] for each in intervals]).T


def draw_dot(axis: Axes, interval: Interval, place: float, colour: str, label: str) -> None:
    """Draw a mean with its interval at a height, and its value beside it."""
    axis.errorbar(
        [interval.mean], [place], xerr=spread([interval]), color=colour, label=label,
        fmt="o", markersize=4, capsize=2.5, linewidth=1.2,
    )  # fmt: skip
    axis.annotate(
        f"{interval.mean:.1f}", (interval.high, place), color=colour,
        xytext=(5, 0), textcoords="offset points", va="center", fontsize=7,
    )  # fmt: skip


LONG_NAME = 24
"""Letters of a row's name beyond which panels stand below one another."""


def draw_errors(
    rows: Sequence[str],
    series: Mapping[str, Mapping[str, Mapping[str, Interval]]],
    log: bool = True,
) -> Figure:
    """Draw dots with 95 % intervals, a panel for each of some errors.

    Args:
        rows: What stands from top to bottom, such as policies.
        series: By colour, row and error, the same errors for all: intervals.
        log: Whether the errors stand on logarithmic axes.
    """
    most = max(sum(row in each for each in series.values()) for row in rows)
    panels = list(next(each[row] for each in series.values() for row in rows if row in each))
    n_columns = min(len(panels), 1 if max(map(len, rows)) > LONG_NAME else 2)
    n_lines = math.ceil(len(panels) / n_columns)
    figure = make_figure(WIDTH, n_lines * (1.0 + (0.18 + 0.12 * most) * len(rows)) + 0.2)
    axes = list(figure.subplots(n_lines, n_columns, sharey=True, squeeze=False).flat)
    for axis in axes[len(panels) :]:
        axis.remove()
    axes[0].set_yticks([-place for place in range(len(rows))], rows)
    colours = dict(zip(series, cycle(COLOURS), strict=False))
    for axis, panel in zip(axes, panels, strict=False):
        for place, row in enumerate(rows):
            own = {name: each[row][panel] for name, each in series.items() if row in each}
            for k, (name, interval) in enumerate(own.items()):
                shift = ((len(own) - 1) / 2 - k) * min(0.3, 0.85 / len(own))
                draw_dot(axis, interval, shift - place, colours[name], name)
        axis.set_xlabel(fill(panel, 48 // n_columns), fontsize=9)
        if log:
            set_log(axis, ERROR_TICKS)
        axis.margins(x=0.2)
        axis.set_ylim(0.5 - len(rows), 0.5)
        add_frame(axis, "x")
    add_legend(figure, axes[:1])
    return figure


@dataclass(frozen=True)
class RoadMap:
    """A panel over space and time.

    Attributes:
        seconds: Densities [veh/km] or flags of queried segments by second, (n_mainline,) each.
        history: The episode, for its scales.
        step: Seconds from one of ``seconds`` to the next.
    """

    title: str
    seconds: Sequence[NDArray[Any]] | FloatArray
    history: History
    step: int = 1

    @property
    def is_flags(self) -> bool:
        """True for a panel of queried segments."""
        return self.seconds[0].dtype == bool


def estimate_map(history: History, rmse: float, title: str) -> RoadMap:
    """Return the panel of the estimated density; its title ends with its RMSE [veh/km]."""
    title = f"{title}, RMSE {rmse:.1f} veh/km"
    return RoadMap(title, history.estimate, history)


def draw_maps(columns: Sequence[Sequence[RoadMap]], height: float = 1.1) -> Figure:
    """Draw panels over space and time with one colour bar for all densities.

    Args:
        columns: Panels of each column from top to bottom; rows have one kind of panel.
        height: Height of a panel of densities [inches].
    """
    ratios = [height * (0.6 if panel.is_flags else 1.0) for panel in columns[0]]
    figure = make_figure(WIDTH, sum(ratios) + 1.2)
    axes = figure.subplots(
        len(ratios), len(columns), squeeze=False, sharex=True, sharey=True,
        gridspec_kw={"height_ratios": ratios},
    )  # fmt: skip
    for k, panels in enumerate(columns):
        for axis, panel in zip(axes[:, k], panels, strict=True):
            image = _draw_map(axis, panel, len(columns))
            if not panel.is_flags:
                densities = image
        axes[-1, k].set_xlabel("time [s]", fontsize=8)
    figure.supylabel("road [km]", fontsize=8)
    bar = figure.colorbar(
        densities, ax=axes.ravel().tolist(), fraction=0.02, pad=0.01, extend="max"
    )
    bar.set_label("density [veh/km]", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


def _draw_map(axis: Axes, panel: RoadMap, n_columns: int) -> AxesImage:
    values = np.array(panel.seconds).T[panel.history.rows]
    axis.set_title(fill(panel.title, 56 // n_columns), loc="left", fontsize=9, pad=3)
    axis.tick_params(labelsize=8)
    return axis.imshow(
        values,
        origin="lower",
        aspect="auto",
        interpolation="nearest",
        extent=(
            -0.5 * panel.step,
            (values.shape[1] - 0.5) * panel.step,
            0.0,
            panel.history.road_length,
        ),
        cmap=SHADES if panel.is_flags else DENSITY_MAP,
        vmin=0.0,
        vmax=1.0 if panel.is_flags else panel.history.density_scale,
    )


class Look(NamedTuple):
    """The look of a curve: colour, marker, and line as matplotlib names them."""

    colour: str
    marker: str
    line: Any = "-"


LABELS = {
    "ekf": "EKF",
    "ukf": "UKF",
    "enkf": "EnKF",
    "mhe": "MHE",
    "random_walk": "random walk",
    "blend": "EKF and random walk",
    "asm": "adaptive smoothing",
    "recurrent": "recurrent",
    "open_loop": "open loop",
}
"""Names of the estimators in figures and tables."""
ESTIMATOR_LOOKS = {
    "ekf": Look(COLOURS[0], "o"),
    "ukf": Look("#d55e00", "s"),
    "enkf": Look("#009e73", "^"),
    "mhe": Look("#cc79a7", "D"),
    "random_walk": Look(INK, "v", "--"),
    "blend": Look("#56b4e9", "P"),
    "open_loop": Look(INK, "", ":"),
}


def draw_curve(
    axis: Axes,
    places: ArrayLike,
    intervals: Sequence[Interval],
    look: Look,
    label: str | None = None,
) -> None:
    """Draw means at their places with intervals as bars."""
    means = np.array([interval.mean for interval in intervals])
    axis.errorbar(
        np.asarray(places), means, yerr=spread(intervals),
        color=look.colour, marker=look.marker, linestyle=look.line,
        markersize=4, linewidth=1.2, capsize=2, label=label,
    )  # fmt: skip


def draw_level(axis: Axes, interval: Interval, label: str) -> None:
    """Draw a mean that no place changes as a line with a band."""
    axis.axhline(interval.mean, color=INK, linestyle=":", linewidth=1.3, label=label)
    axis.axhspan(interval.low, interval.high, color=INK, alpha=0.2, linewidth=0)


def draw_rules(axis: Axes, rules: Mapping[str, float]) -> None:
    """Draw the errors of rules as lines with their names, side by side lest they overlap."""
    for k, (rule, error) in enumerate(sorted(rules.items(), key=lambda each: each[1])):
        axis.axhline(error, color=INK, linestyle=":", linewidth=1.0)
        axis.annotate(
            rule, (1.0 - 0.2 * (k % 5), error), xycoords=("axes fraction", "data"),
            fontsize=7, ha="right", va="bottom",
        )  # fmt: skip


def shifted(places: Sequence[float], share: float, log: bool) -> FloatArray:
    """Move places by a share of their range, so that the bars of curves do not hide one another."""
    array = np.array(places, dtype=np.float64)
    first, last = float(array[0]), float(array[-1])
    moved: FloatArray = array * (last / first) ** share if log else array + share * (last - first)
    return moved
