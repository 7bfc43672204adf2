"""Figures of the study of privacy."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.experiments.cells import DENSITY, METRICS, SPEED
from agents.figures import (
    ESTIMATOR_LOOKS,
    GREY,
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
from agents.studies.privacy.account import Account
from agents.studies.privacy.plan import BOUNDARY_MODES, OPEN_LOOP, Protection
from agents.studies.privacy.results import PrivacyResults

CAPS = ("#9ecae1", "#4292c6", "#2171b5", "#08519c", "#08306b")
"""Shades from the smallest cap, the least noise, to the largest."""
PROTECTION_LOOKS = {
    "event": Look("#009e73", "s", "--"),
    "horizon": Look("#d55e00", "^", "--"),
    "paper": Look("#cc79a7", "D"),
    "corrected": Look("#7d5ba6", "v"),
}
MODE_LABELS = ("nominal", "private", "true\n(no guarantee)")
EPSILON_TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1e3, 1e4, 1e5, 1e6)


def draw_epsilon(results: PrivacyResults) -> Figure:
    """Draw errors against epsilon for every cap and unit, a row for each error."""
    design = results.design
    figure = make_figure(4.6 * len(design.estimators) + 0.6, 7.4)
    axes = figure.subplots(2, len(design.estimators), squeeze=False, sharex=True, sharey="row")
    for row, metric in zip(axes, METRICS, strict=True):
        for axis, name in zip(row, design.estimators, strict=True):
            for k, protection in enumerate(design.guaranteed):
                means = results.means(design.along_epsilon(name, protection), metric)
                places = shifted(design.epsilons, 0.008 * (k - 2), log=True)
                draw_curve(axis, places, means, _look(results, protection), str(protection))
            alone = results.mean(design.cell(OPEN_LOOP), metric)
            draw_level(axis, alone, label="open loop, nominal boundary")
            set_log_axes(axis, design.epsilons)
            axis.set_title(LABELS[name], fontsize=9, loc="left")
        row[0].set_ylabel(error_label(metric))
    for axis in axes[-1]:
        axis.set_xlabel("ε")
    return finish_figure(figure, axes.flat, columns=6)


def draw_modes(results: PrivacyResults) -> Figure:
    """Draw errors by boundary mode and against the bandwidth, a row for each error."""
    design = results.design
    figure = make_figure(9.4, 6.6)
    axes = figure.subplots(2, 2, squeeze=False)
    for row, metric in zip(axes, METRICS, strict=True):
        for k, name in enumerate(design.all_estimators):
            look, label = ESTIMATOR_LOOKS[name], LABELS[name]
            modes = [design.cell(name, boundary_inputs=mode) for mode in BOUNDARY_MODES]
            places = np.arange(len(modes)) + 0.12 * (k - (len(design.all_estimators) - 1) / 2)
            dots = Look(look.colour, look.marker or "x", "")
            draw_curve(row[0], places, results.means(modes, metric), dots, label)
            if name == OPEN_LOOP:
                alone = results.mean(design.cell(name), metric)
                draw_level(row[1], alone, label="open loop, nominal boundary")
                continue
            means = results.means(design.along_bandwidth(name), metric)
            draw_curve(row[1], np.array(design.bandwidths) + 0.12 * (k - 0.5), means, look, label)
        row[0].set_xticks(range(len(BOUNDARY_MODES)), MODE_LABELS)
        row[0].set_xlim(-0.5, len(BOUNDARY_MODES) - 0.5)
        row[1].set_xticks(design.bandwidths)
        row[0].set_ylabel(error_label(metric))
        for axis in row:
            axis.set_ylim(bottom=0.0)
    axes[1, 0].set_xlabel("boundary inputs of the estimator")
    axes[1, 1].set_xlabel("segments queried a second")
    return finish_figure(figure, axes[0], columns=6)


def draw_claimed(results: PrivacyResults) -> Figure:
    """Draw epsilon claimed against true, and the first estimator's errors over both."""
    figure = make_figure(13.6, 7.8, dpi=130)
    axes = figure.subplots(2, 3)
    cap, _ = results.meetings
    _true_epsilon(axes[0, 0], results)
    _errors(axes[1, 0], results, DENSITY, lambda account: account.met[cap])
    axes[1, 0].set_xlabel(f"ε true of densities alone,\nmet {cap} times")
    for row, metric in zip(axes, (DENSITY, SPEED), strict=True):
        _errors(row[1], results, metric, lambda account: account.claimed, shift=0.008)
        row[1].set_xlabel("ε claimed")
        _errors(row[2], results, metric, lambda account: account.alone[cap])
        row[2].set_xlabel(f"ε true of both releases,\nmet {cap} times, alone and standing")
    return finish_figure(figure, [*axes[:, 1], axes[0, 2]], columns=6)


def _errors(
    axis: Axes,
    results: PrivacyResults,
    metric: str,
    epsilon: Callable[[Account], float],
    shift: float = 0.0,
) -> None:
    """Draw errors under the paper's noise and under a guarantee over one kind of epsilon."""
    design = results.design
    name = design.estimators[0]
    drawn: list[float] = []
    for k, protection in enumerate((*design.printed, design.base)):
        places = [epsilon(account) for account in results.accounts[protection]]
        drawn += places
        means = results.means(design.along_epsilon(name, protection), metric)
        moved = shifted(places, shift * (k - 1), log=True)
        label = str(protection).replace("`", "")
        draw_curve(axis, moved, means, _look(results, protection), label)
    for mode, line in (("nominal", ":"), ("true", "--")):
        alone = results.mean(design.cell(OPEN_LOOP, boundary_inputs=mode), metric)
        draw_level(axis, alone, line, f"open loop, {mode} boundary")
    set_log_axes(axis, _ticks(drawn))
    axis.set_ylabel(f"{LABELS[name]}: {error_label(metric)}")


def _true_epsilon(axis: Axes, results: PrivacyResults) -> None:
    """Draw epsilon as composed and as met against epsilon claimed."""
    claimed = np.array(results.design.epsilons)
    cap, horizon = results.meetings
    axis.plot(claimed, claimed, color=GREY, linewidth=1.2)
    kinds: tuple[tuple[str, str, Callable[[Account], float]], ...] = (
        ("composed, own sensitivities", ":", lambda account: account.composed),
        (f"densities alone, met {cap} times", "-", lambda account: account.met[cap]),
        (f"densities alone, met {horizon} times", "--", lambda account: account.met[horizon]),
        (f"both, met {cap} times, alone and standing", "-.", lambda account: account.alone[cap]),
    )
    highest = float(claimed[-1])
    for protection in results.design.printed:
        colour, marker, _ = _look(results, protection)
        for _, line, value in kinds:
            true = [value(account) for account in results.accounts[protection]]
            highest = max(highest, *true)
            axis.plot(claimed, true, line, color=colour, marker=marker, markersize=4, linewidth=1.2)
    set_log_axes(axis, results.design.epsilons)
    set_log_ticks(axis.yaxis, _ticks([float(claimed[0]), highest]))
    axis.set_xlabel("ε claimed")
    axis.set_ylabel("ε true, boundary inputs left out")
    axis.set_ylim(top=highest * 3e3)  # space for the legend
    # Colours are named below the panels.
    handles = axis.plot([], [], color=GREY, label="as claimed, and as guaranteed")
    for label, line, _ in kinds:
        handles += axis.plot([], [], line, color="#888888", label=label)
    axis.legend(handles=handles, fontsize=7, frameon=False, loc="upper left")


def _ticks(values: Sequence[float]) -> list[float]:
    """Return ticks for epsilon: decades alone where there are many."""
    low, high = min(values), max(values)
    ticks = EPSILON_TICKS if high < 300.0 * low else [10.0**k for k in range(-2, 9)]
    return [tick for tick in ticks if low / 1.5 <= tick <= high * 1.5]


def _look(results: PrivacyResults, protection: Protection) -> Look:
    if protection.cap:
        caps = results.design.caps
        shade = round((len(CAPS) - 1) * (caps.index(protection.cap) + 1) / len(caps))
        return Look(CAPS[shade], "o")
    return PROTECTION_LOOKS[
        protection.unit if protection.unit in PROTECTION_LOOKS else protection.preset
    ]
