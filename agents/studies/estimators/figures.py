"""Figures of the study of estimators."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from agents.evaluation.honesty import LEVELS
from agents.experiments.cells import ERROR
from agents.figures import add_frame, draw_dot, finish_figure, make_figure
from agents.studies.estimators.cell import ESTIMATOR_LABELS, LEARNED, LINEAR
from agents.studies.estimators.results import EstimatorResults

COLOURS = {
    "ekf": "#0072b2", "ukf": "#d55e00", "enkf": "#009e73", "mhe": "#cc79a7",
    "random_walk": "#666666", "blend": "#56b4e9", LINEAR: "#e69f00", LEARNED: "#000000",
}  # fmt: skip


def draw_worlds(results: EstimatorResults) -> Figure:
    """Draw the error of every estimator in each main world under the base schedule."""
    design = results.design
    names = (*design.quick_estimators, *design.slow_estimators)
    figure = make_figure(11.0, 3.6)
    axes = figure.subplots(1, len(design.main), sharey=True, squeeze=False)[0]
    for axis, (world, each) in zip(axes, design.main.items(), strict=True):
        for k, name in enumerate(names):
            interval = results.mean(design.cell(world, name), ERROR)
            draw_dot(axis, interval, float(k), COLOURS[name], None)
        axis.set_title(each.label.replace("`", "").replace(", ", ",\n"), fontsize=9)
        axis.set_xlabel("error x 1000", fontsize=8)
        axis.set_yticks(range(len(names)), [ESTIMATOR_LABELS[name] for name in names])
        axis.margins(x=0.25)
        add_frame(axis, "x")
        axis.set_xlim(left=0.0)
    axes[0].invert_yaxis()  # shared by all
    return figure


def draw_elsewhere(results: EstimatorResults) -> Figure:
    """Draw by how much the network's error lies below the EKF's away from the base world."""
    design = results.design
    figure = make_figure(7.4, 5.6)
    axis = figure.subplots()
    for k, world in enumerate(design.elsewhere):
        below = results.below(design.cell(world), design.cell(world, "ekf"))
        draw_dot(axis, below, float(k), COLOURS[LEARNED] if below.low > 0.0 else "#d55e00", None)
    labels = [each.label.replace("`", "") for each in design.elsewhere.values()]
    axis.set_yticks(range(len(labels)), labels)
    axis.axvline(0.0, color="#333333", linewidth=1.0)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.set_xlabel("error of the network below that of the EKF [%]", fontsize=8)
    add_frame(axis, "x")
    return figure


def draw_coverage(results: EstimatorResults) -> Figure:
    """Draw the coverage of reported intervals against what it should be, in each main world."""
    design = results.design
    figure = make_figure(11.0, 3.4)
    axes = figure.subplots(1, len(design.main), sharey=True, squeeze=False)[0]
    for axis, (world, each) in zip(axes, design.main.items(), strict=True):
        axis.plot([0, 100], [0, 100], color="#999999", linewidth=1.0, linestyle=":")
        for name in design.moved_estimators:
            cell = design.cell(world, name)
            for quantity, line in (("density", "-"), ("speed", "--")):
                covered = [np.mean(results.values(cell, f"{quantity}_{level}")) for level in LEVELS]
                axis.plot(
                    LEVELS, covered, color=COLOURS[name], linestyle=line, marker="o",
                    markersize=3, linewidth=1.2, label=f"{ESTIMATOR_LABELS[name]}, {quantity}",
                )  # fmt: skip
        axis.set_title(each.label.replace("`", "").replace(", ", ",\n"), fontsize=9)
        axis.set_xticks(LEVELS)
        axis.set_xlim(45, 100)
        axis.set_ylim(30, 102)
        axis.set_xlabel("nominal [%]", fontsize=8)
    axes[0].set_ylabel("covered [%]", fontsize=8)
    return finish_figure(figure, columns=6)
