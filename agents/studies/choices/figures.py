"""Figures of the study of choices."""

from __future__ import annotations

from matplotlib.figure import Figure

from agents.figures import (
    GREY,
    Look,
    draw_curve,
    finish_figure,
    make_figure,
    set_log_ticks,
    shifted,
)
from agents.studies.choices.cell import ROADS
from agents.studies.choices.plan import GAIN, ORACLE
from agents.studies.choices.results import ChoiceResults

RULE, LEARNED = Look("#0072b2", "o"), Look("#d55e00", "s")
BOUNDS = {ORACLE: Look("#666666", "^", ":"), GAIN: Look("#333333", "v", "--")}


def draw_gains(results: ChoiceResults) -> Figure:
    """Draw gains over the base schedule against the share of the road that is queried."""
    design = results.design
    figure = make_figure(11.0, 5.6)
    columns = (len(design.worlds) + 1) // 2
    axes = figure.subplots(2, columns, sharey=True, squeeze=False).ravel()
    for axis, world in zip(axes, design.worlds, strict=False):
        bandwidths = design.bandwidths_of(world)
        shares = [100.0 * design.cell(world, each, "").share for each in bandwidths]
        curves = [("rule", [design.rule(world)], RULE)]
        curves += [(bound, [bound], BOUNDS[bound]) for bound in design.bounds(world)]
        if design.learned(world):
            curves.append(("learned", list(design.learned(world)), LEARNED))
        for k, (label, policies, look) in enumerate(curves):
            gains = [results.gain(world, each, policies) for each in bandwidths]
            draw_curve(axis, shifted(shares, 0.01 * (k - 1), log=True), gains, look, label)
        axis.axhline(0.0, color=GREY, linewidth=0.8)
        axis.set_xscale("log")
        set_log_ticks(axis.xaxis, [round(share, 1) for share in shares])
        road = ROADS[world.road].label.partition(",")[0]
        axis.set_title(f"{road}, {world.label.replace('`', '')}", fontsize=9)
        axis.set_xlabel("segments queried a second [%]", fontsize=8)
    for axis in axes[len(design.worlds) :]:
        axis.remove()
    for axis in axes[::columns]:
        axis.set_ylabel(f"error below {design.schedule} [%]", fontsize=8)
    return finish_figure(figure, columns=4)
