"""The figures of the study."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from agents.evaluation.figures import save
from agents.evaluation.statistics import Interval
from agents.studies.paper.measures import LABELS
from agents.studies.privacy.account import Account
from agents.studies.privacy.plan import BOUNDARY_MODES, OPEN_LOOP, Cell, Protection
from agents.studies.privacy.results import DENSITY, METRICS, SPEED, Measured

CAPS = ("#9ecae1", "#4292c6", "#2171b5", "#08519c", "#08306b")
"""From the smallest cap, the least noise, to the largest."""
OTHER = {
    "event": ("#009e73", "s", "--"),
    "horizon": ("#d55e00", "^", "--"),
    "paper": ("#cc79a7", "D", "-"),
    "corrected": ("#7d5ba6", "v", "-"),
}
ESTIMATORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b9770e")
GREY = "#333333"
TICKS = (2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300, 500)
EPSILON_TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1e3, 1e4, 1e5, 1e6)


class Look(NamedTuple):
    """How a curve looks."""

    colour: str
    marker: str
    line: str


def save_epsilon(path: Path, measured: Measured, title: str) -> None:
    """Save errors against epsilon for every cap and unit, a row for each error."""
    design = measured.design
    figure = Figure(figsize=(4.6 * len(design.estimators) + 0.6, 7.4), dpi=140)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2, len(design.estimators), squeeze=False, sharex=True, sharey="row")
    for row, metric in zip(axes, METRICS, strict=True):
        for axis, name in zip(row, design.estimators, strict=True):
            for k, protection in enumerate(design.guaranteed):
                cells = design.along_epsilon(name, protection)
                places = _beside(design.epsilons, k - 2)
                look = _look(measured, protection)
                _curve(axis, places, _means(measured, cells, metric), look, str(protection))
            alone = measured.mean(design.cell(OPEN_LOOP), metric)
            _line(axis, alone, "open loop, nominal boundary")
            _log(axis, design.epsilons)
            axis.set_title(LABELS[name], fontsize=9, loc="left")
        row[0].set_ylabel(_axis_label(metric))
    for axis in axes[-1]:
        axis.set_xlabel("ε")
    _finish(figure, axes.flat, title, path)


def save_modes(path: Path, measured: Measured, title: str) -> None:
    """Save errors by boundary mode and against the bandwidth, a row for each error."""
    design = measured.design
    figure = Figure(figsize=(9.4, 6.6), dpi=140)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2, 2, squeeze=False)
    for row, metric in zip(axes, METRICS, strict=True):
        for k, name in enumerate(design.all_estimators):
            colour = GREY if name == OPEN_LOOP else ESTIMATORS[k % len(ESTIMATORS)]
            marker = "os^Dv"[k % 5]
            modes = [design.cell(name, boundary_inputs=mode) for mode in BOUNDARY_MODES]
            places = np.arange(len(modes)) + 0.12 * (k - (len(design.all_estimators) - 1) / 2)
            _curve(
                row[0],
                places,
                _means(measured, modes, metric),
                Look(colour, marker, ""),
                LABELS[name],
            )
            if name == OPEN_LOOP:
                _line(row[1], measured.mean(design.cell(name), metric), "open loop, nominal")
                continue
            means = _means(measured, design.along_bandwidth(name), metric)
            shifted = np.array(design.bandwidths) + 0.12 * (k - 0.5)
            _curve(row[1], shifted, means, Look(colour, marker, "-"), LABELS[name])
        row[0].set_xticks(range(len(BOUNDARY_MODES)), _MODES)
        row[0].set_xlim(-0.5, len(BOUNDARY_MODES) - 0.5)
        row[1].set_xticks(design.bandwidths)
        row[0].set_ylabel(_axis_label(metric))
        for axis in row:
            axis.set_ylim(bottom=0.0)
    axes[1, 0].set_xlabel("boundary inputs of the estimator")
    axes[1, 1].set_xlabel("segments queried a second")
    _finish(figure, axes[0], title, path)


_MODES = ("nominal", "private", "true\n(no guarantee)")


class Panel(NamedTuple):
    """A panel of errors: which error, over which epsilon."""

    metric: str
    over: str


PANELS = (
    (Panel(DENSITY, "claimed"), Panel(DENSITY, "alone")),
    (Panel(SPEED, "claimed"), Panel(SPEED, "alone")),
)


def save_claimed(path: Path, measured: Measured, title: str) -> None:
    """Save epsilon claimed against true, and the first estimator's errors over either."""
    figure = Figure(figsize=(13.6, 7.8), dpi=130)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2, 3)
    _true_epsilon(axes[0, 0], measured)
    _errors(axes[1, 0], measured, Panel(DENSITY, "met"))
    for row, panels in zip(axes, PANELS, strict=True):
        for axis, panel in zip(row[1:], panels, strict=True):
            _errors(axis, measured, panel)
    _finish(figure, [*axes[:, 1], axes[0, 2]], title, path)


def _errors(axis: Any, measured: Measured, panel: Panel) -> None:
    """Draw errors under the paper's noise and under a guarantee over one kind of epsilon."""
    design, (cap, _) = measured.design, measured.meetings
    name = design.estimators[0]
    drawn: list[float] = []
    for k, protection in enumerate((*design.printed, design.base)):
        accounts = measured.accounts[protection]
        places = [getattr(own, panel.over) for own in accounts]
        if panel.over != "claimed":
            places = [own[cap] for own in places]
        drawn += places
        means = _means(measured, design.along_epsilon(name, protection), panel.metric)
        shifted = _beside(places, k - 1) if panel.over == "claimed" else places
        _curve(axis, shifted, means, _look(measured, protection), _plain(protection))
    for mode, style in (("nominal", ":"), ("true", "--")):
        alone = measured.mean(design.cell(OPEN_LOOP, boundary_inputs=mode), panel.metric)
        _line(axis, alone, f"open loop, {mode} boundary", style)
    _log(axis, _ticks(drawn))
    axis.set_ylabel(f"{LABELS[name]}: {_axis_label(panel.metric)}")
    axis.set_xlabel(
        {
            "claimed": "ε claimed",
            "met": f"ε true of densities alone,\nmet {cap} times",
            "alone": f"ε true of both releases,\nmet {cap} times, alone and standing",
        }[panel.over]
    )


def _plain(protection: Protection) -> str:
    """Name a protection without the marks of Markdown."""
    return str(protection).replace("`", "")


def _true_epsilon(axis: Any, measured: Measured) -> None:
    """Draw epsilon as composed and as met against epsilon claimed."""
    claimed = np.array(measured.design.epsilons)
    cap, horizon = measured.meetings
    axis.plot(claimed, claimed, color=GREY, linewidth=1.2)
    ways: tuple[tuple[str, str, Callable[[Account], float]], ...] = (
        ("composed, own sensitivities", ":", lambda one: one.composed),
        (f"densities alone, met {cap} times", "-", lambda one: one.met[cap]),
        (f"densities alone, met {horizon} times", "--", lambda one: one.met[horizon]),
        (f"both, met {cap} times, alone and standing", "-.", lambda one: one.alone[cap]),
    )
    highest = float(claimed[-1])
    for protection in measured.design.printed:
        colour, marker, _ = _look(measured, protection)
        for _, line, value in ways:
            true = [value(one) for one in measured.accounts[protection]]
            highest = max(highest, *true)
            axis.plot(claimed, true, line, color=colour, marker=marker, markersize=4, linewidth=1.2)
    _log(axis, measured.design.epsilons)
    axis.yaxis.set_major_locator(FixedLocator(_ticks([float(claimed[0]), highest])))
    axis.set_xlabel("ε claimed")
    axis.set_ylabel("ε true, boundary inputs left out")
    axis.set_ylim(top=highest * 3e3)  # room for the legend
    # Colours are named below the panels.
    (own,) = axis.plot([], [], color=GREY, label="as claimed, and as guaranteed")
    handles = [axis.plot([], [], line, color="#888888", label=says)[0] for says, line, _ in ways]
    axis.legend(handles=[own, *handles], fontsize=7, frameon=False, loc="upper left")


def _ticks(values: Sequence[float]) -> list[float]:
    """Return ticks for epsilon: decades alone where there are many."""
    low, high = min(values), max(values)
    ticks = EPSILON_TICKS if high < 300.0 * low else [10.0**k for k in range(-2, 9)]
    return [tick for tick in ticks if low / 1.5 <= tick <= high * 1.5]


def _look(measured: Measured, protection: Protection) -> Look:
    if protection.cap:
        caps = measured.design.caps
        shade = round((len(CAPS) - 1) * (caps.index(protection.cap) + 1) / len(caps))
        return Look(CAPS[shade], "o", "-")
    key = protection.unit if protection.unit in OTHER else protection.preset
    return Look(*OTHER[key])


def _means(measured: Measured, cells: Sequence[Cell], metric: str) -> list[Interval]:
    return [measured.mean(cell, metric) for cell in cells]


def _beside(places: Sequence[float], shift: float) -> Any:
    """Move points a little aside on a logarithmic axis, so that bars do not hide one another."""
    return np.array(places) * (places[-1] / places[0]) ** (0.008 * shift)


def _curve(axis: Any, places: Any, intervals: Sequence[Interval], look: Look, label: str) -> None:
    spread = [[own.mean - own.low, own.high - own.mean] for own in intervals]
    axis.errorbar(
        places,
        [own.mean for own in intervals],
        yerr=np.array(spread).T,
        color=look.colour,
        marker=look.marker,
        linestyle=look.line,
        markersize=4.5,
        linewidth=1.3,
        capsize=2,
        label=label,
    )


def _line(axis: Any, interval: Interval, label: str, style: str = ":") -> None:
    axis.axhline(interval.mean, color=GREY, linestyle=style, linewidth=1.3, label=label)
    axis.axhspan(interval.low, interval.high, color=GREY, alpha=0.10, linewidth=0)


def _log(axis: Any, ticks: Sequence[float]) -> None:
    """Make both axes logarithmic, with plain numbers."""
    for scale, own, places in (
        (axis.set_xscale, axis.xaxis, ticks),
        (axis.set_yscale, axis.yaxis, TICKS),
    ):
        scale("log")
        own.set_major_locator(FixedLocator(list(places)))
        own.set_minor_locator(NullLocator())
        own.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _axis_label(metric: str) -> str:
    name, unit = METRICS[metric]
    return f"{name} RMSE [{unit}]"


def _finish(figure: Figure, axes: Iterable[Any], title: str, path: Path) -> None:
    """Name every curve once below the panels, and save."""
    axes = list(axes)
    for axis in figure.axes:
        axis.grid(color="#e3e6ea", linewidth=0.7)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
    named: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    figure.legend(
        list(named.values()),
        list(named),
        loc="outside lower center",
        ncols=min(len(named), 6),
        frameon=False,
        fontsize=8,
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    save(figure, path)
