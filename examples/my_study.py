"""A study of one's own: does it pay to query the segments around a speed front?

python my_study.py

It plays two rules with three bandwidths on eight traffic seeds, in half a minute, and writes
``rows.parquet`` (an episode a line), ``tables.md`` and a figure to ``results/my-study``. An
interrupted run goes on. The command has more options, as ``--report``, which writes tables and
figure again from the rows alone:

dptse study my_study:STUDY --report
"""

# ruff: noqa: E402 (the tools are importable once their folder is on the path)
from dptse_env.tools import add_tools_path

add_tools_path()

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
from agents.study import Place, Study, run
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


if __name__ == "__main__":
    run(STUDY, Place(Path("results/my-study")))
