"""Figures of the study of ledgers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.experiments.cells import METRICS
from agents.figures import (
    ERROR_TICKS,
    Look,
    add_frame,
    add_legend,
    draw_curve,
    draw_dot,
    draw_level,
    error_label,
    finish_figure,
    make_figure,
    set_log_axes,
    set_log_ticks,
    shifted,
)
from agents.statistics import Interval
from agents.studies.ledger.cell import CAPPED, EXACT, PACED
from agents.studies.ledger.plan import Named
from agents.studies.ledger.results import LedgerResults
from agents.studies.ledger.tables import LENGTH_LABELS

COLOURS = {CAPPED: "#d55e00", PACED: "#0072b2", EXACT: "#333333"}
MECHANISM_LABELS = {CAPPED: "capped", PACED: "paced", EXACT: "no noise, no guarantee"}
LINES = (("o", "-"), ("s", "--"))
"""Marker and line of the base delta and of the smaller one."""
TRIP_LOOKS = (
    Look("#0072b2", "o"), Look("#56b4e9", "s"), Look("#009e73", "^"), Look("#cc79a7", "D"),
    Look("#d55e00", "v"), Look("#e69f00", "x", "--"), Look("#666666", "+", "--"),
)  # fmt: skip


def draw_epsilon(results: LedgerResults) -> Figure:
    """Draw both errors against epsilon, for both mechanisms and both values of delta."""
    design = results.design
    figure = make_figure(9.8, 4.6)
    axes = figure.subplots(1, 2)
    for axis, metric in zip(axes, METRICS, strict=True):
        for k, mechanism in enumerate((CAPPED, PACED)):
            for m, delta in enumerate(design.deltas):
                means = results.means(design.along_epsilon(mechanism, delta), metric)
                look = Look(COLOURS[mechanism], *LINES[m])
                places = shifted(design.epsilons, 0.008 * (2 * k + m - 1.5), log=True)
                draw_curve(axis, places, means, look, f"{mechanism}, δ = {delta:g}")
        shipped = f"capped as shipped, ({design.epsilon:g}, {design.delta:g})"
        draw_level(axis, results.mean(design.shipped, metric), "--", shipped)
        draw_level(axis, results.mean(design.cell(EXACT), metric), ":", MECHANISM_LABELS[EXACT])
        set_log_axes(axis, design.epsilons)
        axis.set_xlabel("ε")
        axis.set_ylabel(error_label(metric))
    return finish_figure(figure, axes[:1], columns=3)


def draw_ladder(results: LedgerResults) -> Figure:
    """Draw the errors of every rung, coloured by mechanism, from top to bottom."""
    ladder = results.design.ladder()
    figure = make_figure(9.8, 1.4 + 0.34 * len(ladder))
    axes = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(ladder))[::-1]
    for axis, metric in zip(axes, METRICS, strict=True):
        named: set[str] = set()
        for place, rung in zip(places, ladder, strict=True):
            mechanism = rung.cell.mechanism
            label = None if mechanism in named else MECHANISM_LABELS[mechanism]
            named.add(mechanism)
            mean = results.mean(rung.cell, metric)
            draw_dot(axis, mean, float(place), COLOURS[mechanism], label)
        axis.set_xscale("log")
        set_log_ticks(axis.xaxis, ERROR_TICKS)
        axis.margins(x=0.12)
        axis.set_xlabel(error_label(metric))
        add_frame(axis, "x")
    labels = [f"{k}. {rung.label}".replace("`", "") for k, rung in enumerate(ladder, start=1)]
    axes[0].set_yticks(places, labels)
    add_legend(figure, axes[:1])
    return figure


def draw_ledgers(results: LedgerResults, cells: Sequence[Named]) -> Figure:
    """Draw what trips have spent, and what was refused, by length of trip and by place."""
    figure = make_figure(13.6, 4.8, dpi=130)
    axes = figure.subplots(1, 3)
    for k, ((label, cell), look) in enumerate(zip(cells, TRIP_LOOKS, strict=False)):
        name, shift = label.replace("`", ""), 0.09 * (k - (len(cells) - 1) / 2)
        _draw_lengths(axes[0], results.spent_by_length(cell), shift, look, name)
        _draw_lengths(axes[1], results.refused_by_length(cell), shift, look, name)
        places = results.refused_by_place(cell)
        draw_curve(axes[2], np.arange(len(places)) + shift, places, look, name)
    axes[0].set_ylabel("spent at the end of a trip [% of the budget]")
    axes[1].set_ylabel("contributions refused [%]")
    axes[2].set_ylabel("contributions refused [%]")
    for axis in axes[:2]:
        axis.set_xticks(range(len(LENGTH_LABELS)), [_short(label) for label in LENGTH_LABELS])
        axis.set_xlabel("time on the mainline [s]")
    axes[2].set_xlabel("mainline segment")
    for axis in axes:
        axis.set_ylim(bottom=0.0)
    return finish_figure(figure, axes[:1], columns=4)


def _draw_lengths(
    axis: Axes, shares: Sequence[Interval | None], shift: float, look: Look, label: str
) -> None:
    """Draw shares by length of trip, leaving out the bins with too few trips."""
    there = [(k, share) for k, share in enumerate(shares) if share is not None]
    draw_curve(axis, [k + shift for k, _ in there], [share for _, share in there], look, label)


def _short(label: str) -> str:
    return label.replace(" s or more", "+").replace(" s", "").replace(" to ", "–")
