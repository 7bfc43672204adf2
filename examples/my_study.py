"""A study of one's own: does it pay to query the segments around a speed front?

It plays two rules with three bandwidths on eight traffic seeds, in half a minute, and writes
``rows.parquet`` (an episode a line), ``tables.md`` and a figure. An interrupted run goes on, and
``--report`` writes tables and figure again from the rows alone.

dptse study examples.my_study:STUDY --output results/my-study
dptse study examples.my_study:STUDY --output results/my-study --report
"""

from pathlib import Path

import polars as pl

from agents.figures import (
    ESTIMATOR_LOOKS,
    draw_curve,
    finish_figure,
    make_figure,
    save_figure,
)
from agents.play import Cell
from agents.statistics import Interval
from agents.study import Study
from agents.tables import (
    DENSITY,
    METRICS,
    UnmeasuredError,
    below,
    error_label,
    format_interval,
    grid,
    mean,
)

ENV = "dptse_env:dptse/ShortHighway-v0"
RULES = ("round-robin", "speed-front")
BANDWIDTHS = (1, 2, 3)

CELLS = tuple(
    Cell(
        env=ENV,
        policy=rule,
        keywords={"bandwidth": bandwidth, "estimator": "ekf"},
        labels={"rule": rule, "bandwidth": bandwidth},
    )
    for rule in RULES
    for bandwidth in BANDWIDTHS
)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw errors against the bandwidth."""

    def error(rule: str, bandwidth: int, metric: str) -> Interval:
        return mean(rows, {"rule": rule, "bandwidth": bandwidth}, metric)

    def gain(_: str, bandwidth: int) -> str:
        new, old = ({"rule": rule, "bandwidth": bandwidth} for rule in reversed(RULES))
        return format_interval(below(rows, new, old))

    parts = []
    for metric, (name, unit) in METRICS.items():
        parts.append(f"## RMSE of {name} [{unit}]")
        parts.append(
            grid(
                "rule",
                RULES,
                BANDWIDTHS,
                lambda rule, b, metric=metric: format_interval(error(rule, b, metric)),
            )
        )
    parts.append("## Error of speed-front below round-robin, paired [%]")
    parts.append(grid("", ["gain"], BANDWIDTHS, gain))

    figure = make_figure(5.0, 3.4)
    axis = figure.subplots()
    for rule, look in zip(RULES, ESTIMATOR_LOOKS.values(), strict=False):
        try:
            errors = [error(rule, bandwidth, DENSITY) for bandwidth in BANDWIDTHS]
        except UnmeasuredError:
            continue
        draw_curve(axis, BANDWIDTHS, errors, look, rule)
    axis.set_xticks(BANDWIDTHS)
    axis.set_xlabel("segments queried a second")
    axis.set_ylabel(error_label(DENSITY))
    save_figure(finish_figure(figure), folder / "errors.png", "ShortHighway-v0, EKF")
    return "\n\n".join(parts)


STUDY = Study("my-study", CELLS, tuple(range(2000, 2008)), report)
