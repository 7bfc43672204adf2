"""Shared parts of the figures of studies: looks of estimators, curves, levels, log axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from agents.evaluation.figures import ERROR_TICKS, set_log_ticks, spread
from agents.evaluation.statistics import Interval
from agents.experiments.cells import METRICS
from dptse_env.utils.arrays import FloatArray

GREY = "#333333"


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
    "recurrent": "recurrent",
    "open_loop": "open loop",
}
"""Names of the estimators in figures and tables."""
ESTIMATOR_LOOKS = {
    "ekf": Look("#0072b2", "o"),
    "ukf": Look("#d55e00", "s"),
    "enkf": Look("#009e73", "^"),
    "mhe": Look("#cc79a7", "D"),
    "random_walk": Look("#666666", "v", "--"),
    "blend": Look("#56b4e9", "P"),
    "open_loop": Look("#000000", "", ":"),
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


def draw_level(axis: Axes, interval: Interval, line: Any = ":", label: str | None = None) -> None:
    """Draw a mean that no place changes as a line with a band."""
    axis.axhline(interval.mean, color=GREY, linestyle=line, linewidth=1.3, label=label)
    axis.axhspan(interval.low, interval.high, color=GREY, alpha=0.11, linewidth=0)


def error_label(metric: str) -> str:
    """Return the label of an axis of an error, with its unit."""
    name, unit = METRICS[metric]
    return f"{name} RMSE [{unit}]"


def set_log_axes(axis: Axes, ticks: Sequence[float]) -> None:
    """Make both axes logarithmic with plain numbers, the upright one for errors."""
    axis.set_xscale("log")
    set_log_ticks(axis.xaxis, ticks)
    axis.set_yscale("log")
    set_log_ticks(axis.yaxis, ERROR_TICKS)


def shifted(places: Sequence[float], share: float, log: bool) -> FloatArray:
    """Move places by a share of their range, so that the bars of curves do not hide one another."""
    array = np.array(places, dtype=np.float64)
    first, last = float(array[0]), float(array[-1])
    moved: FloatArray = array * (last / first) ** share if log else array + share * (last - first)
    return moved
