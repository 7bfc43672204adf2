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

from functools import partial
from pathlib import Path

import polars as pl
from matplotlib.figure import Figure

from agents.figures import ESTIMATOR_LOOKS, draw_curve, finish_figure, make_figure, save_measured
from agents.play import Cell
from agents.study import Place, Study, run
from agents.tables import DENSITY, METRICS, below, error_label, format_interval, grid, mean

ENV = "dptse_env:dptse/ShortHighway-v0"
RULES = ("round-robin", "speed-front")
BANDWIDTHS = (1, 2, 3)


def labels(rule: str, bandwidth: int) -> dict[str, str | int]:
    """Return the labels by which a cell is found again among the rows."""
    return {"rule": rule, "bandwidth": bandwidth}


CELLS = tuple(
    Cell(
        env=ENV,
        policy=rule,
        keywords={"bandwidth": bandwidth, "estimator": "ekf"},
        labels=labels(rule, bandwidth),
    )
    for rule in RULES
    for bandwidth in BANDWIDTHS
)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw errors against the bandwidth."""

    def error(metric: str, rule: str, bandwidth: int) -> str:
        return format_interval(mean(rows, labels(rule, bandwidth), metric))

    def gain(_: str, bandwidth: int) -> str:
        old, new = (labels(rule, bandwidth) for rule in RULES)
        return format_interval(below(rows, new, old))

    parts = []
    for metric in METRICS:
        parts += [
            f"## {error_label(metric)}",
            grid("rule", RULES, BANDWIDTHS, partial(error, metric)),
        ]
    parts += ["## Error of speed-front below round-robin, paired [%]"]
    parts += [grid("", ["gain"], BANDWIDTHS, gain)]
    save_measured(folder / "errors.png", "ShortHighway-v0, EKF", draw, rows)
    return "\n\n".join(parts)


def draw(rows: pl.DataFrame) -> Figure:
    """Draw errors against the bandwidth."""
    figure = make_figure(5.0, 3.4)
    axis = figure.subplots()
    for rule, look in zip(RULES, ESTIMATOR_LOOKS.values(), strict=False):
        errors = [mean(rows, labels(rule, bandwidth), DENSITY) for bandwidth in BANDWIDTHS]
        draw_curve(axis, BANDWIDTHS, errors, look, rule)
    axis.set_xticks(BANDWIDTHS)
    axis.set_xlabel("segments queried a second")
    axis.set_ylabel(error_label(DENSITY))
    return finish_figure(figure)


STUDY = Study("my-study", CELLS, tuple(range(2000, 2008)), report)


if __name__ == "__main__":
    run(STUDY, Place(Path("results/my-study")))
