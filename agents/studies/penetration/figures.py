"""Figures of the study of penetration."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.experiments.cells import ERROR, METRICS
from agents.figures import (
    ERROR_TICKS,
    ESTIMATOR_LOOKS,
    LABELS,
    Look,
    draw_curve,
    draw_level,
    error_label,
    finish_figure,
    make_figure,
    set_log_axes,
    set_log_ticks,
    shifted,
)
from agents.studies.penetration.results import PenetrationResults

LOOKS = {**ESTIMATOR_LOOKS, "recurrent": Look("#000000", "*")}
FUSED, QUERIES = Look("#d55e00", "s"), Look("#0072b2", "o", "--")
SHOWN = ("ekf", "recurrent")
"""Estimators of the figure of arms."""


def draw_errors(results: PenetrationResults) -> Figure:
    """Draw density and speed errors of every estimator against the share, by release model."""
    design = results.design
    figure = make_figure(11.0, 6.2)
    axes = figure.subplots(len(METRICS), len(design.releases), sharey="row", squeeze=False)
    for row, metric in zip(axes, METRICS, strict=True):
        for axis, release in zip(row, design.releases, strict=True):
            for k, estimator in enumerate(design.estimators):
                cells = [design.fused(release, estimator, share) for share in design.shares]
                places = shifted(_places(results), 0.012 * (k - 2), log=True)
                means = results.means(cells, metric)
                draw_curve(axis, places, means, LOOKS[estimator], LABELS[estimator])
            _finish(axis, results, release)
        row[0].set_ylabel(error_label(metric), fontsize=8)
    return finish_figure(figure, columns=6)


def draw_arms(results: PenetrationResults) -> Figure:
    """Draw the error of both kinds of sensors, and of either alone, against the share."""
    design = results.design
    shown: Sequence[str] = [each for each in SHOWN if each in design.estimators]
    figure = make_figure(11.0, 0.4 + 2.9 * len(shown))
    axes = figure.subplots(len(shown), len(design.releases), sharey="row", squeeze=False)
    for row, estimator in zip(axes, shown, strict=True):
        for axis, release in zip(row, design.releases, strict=True):
            draw_level(
                axis,
                results.mean(design.alone(release, estimator), ERROR),
                label="detectors alone, with the whole budget",
            )
            for k, (label, cell, look) in enumerate(
                (("queries and detectors", design.fused, FUSED),
                 ("queries alone", design.queries, QUERIES))
            ):  # fmt: skip
                cells = [cell(release, estimator, share) for share in design.shares]
                places = shifted(_places(results), 0.015 * k, log=True)
                draw_curve(axis, places, results.means(cells, ERROR), look, label)
            _finish(axis, results, f"{release}, {LABELS[estimator]}")
        row[0].set_ylabel("error x 1000", fontsize=8)
    return finish_figure(figure)


def _places(results: PenetrationResults) -> list[float]:
    return [100.0 * share for share in results.design.shares]


def _finish(axis: Axes, results: PenetrationResults, title: str) -> None:
    set_log_axes(axis, _places(results))
    set_log_ticks(axis.yaxis, ERROR_TICKS)
    axis.set_title(title, fontsize=9)
    axis.set_xlabel("connected vehicles [%]", fontsize=8)
