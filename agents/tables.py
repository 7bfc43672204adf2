"""Tables of reports: rows by their labels, means, paired differences, and Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from agents.statistics import Interval, mean_interval
from dptse_env.utils.arrays import FloatArray
from dptse_env.versions import code_version, numbers_of

DENSITY, SPEED, ERROR = "rmse_density", "rmse_speed", "error"
HONESTY = ("chi2_density", "chi2_speed")
METRICS = {DENSITY: ("density", "veh/km"), SPEED: ("speed", "km/h")}
"""Name and unit of each error of an estimate; `ERROR` is minus the mean reward, x 1000."""


def error_label(metric: str) -> str:
    """Return the name of an error with its unit, for a column or an axis."""
    if metric == ERROR:
        return "error x 1000"
    name, unit = METRICS[metric]
    return f"{name} RMSE [{unit}]"


Labels = Mapping[str, Any]


class UnmeasuredError(LookupError):
    """The rows that a number needs are not there."""


def numbers(rows: pl.DataFrame) -> pl.Series:
    """Return the name of the numbers of each row, see `dptse_env.versions.numbers_of`."""
    versions = rows["version"]
    return versions.replace({each: numbers_of(each) for each in versions.unique()})


def are_present(rows: pl.DataFrame) -> pl.Series:
    """Return which rows have the numbers of this code."""
    return numbers(rows) == numbers_of(code_version())


def pick(rows: pl.DataFrame, labels: Labels) -> pl.DataFrame:
    """Return the rows of a cell by its labels, in the order of traffic seeds.

    Where it was played with several numbers, it is the rows of the last ones.

    Raises:
        UnmeasuredError: There are none.
        ValueError: The labels are those of several cells.
    """
    found = _with_labels(rows, labels)
    if found.is_empty():
        raise UnmeasuredError(dict(labels))
    versions = numbers(found)
    return _one_cell(found.filter(versions == versions[-1]), labels)


def pick_paired(rows: pl.DataFrame, *cells: Labels) -> list[pl.DataFrame]:
    """Return the rows of cells on the traffic seeds that they share, of equal numbers.

    It is the last numbers with which all of them were played.

    Raises:
        UnmeasuredError: With none were all of them played on two traffic seeds.
        ValueError: Labels are those of several cells.
    """
    rows = rows.with_columns(version=numbers(rows))
    found = [_with_labels(rows, each) for each in cells]
    played = [dict.fromkeys(each.select("version", "traffic_seed").iter_rows()) for each in found]
    shared = [key for key in played[0] if all(key in each for each in played[1:])]
    seeds = [seed for version, seed in shared if version == shared[-1][0]]
    if len(seeds) < 2:
        raise UnmeasuredError(
            "cells were not played on two traffic seeds by versions of equal numbers", *cells
        )
    return [
        _one_cell(each.filter(pl.col("traffic_seed").is_in(seeds), version=shared[-1][0]), labels)
        for each, labels in zip(found, cells, strict=True)
    ]


def _with_labels(rows: pl.DataFrame, labels: Labels) -> pl.DataFrame:
    """Return the rows that have some labels; a part that was not played has no column."""
    return rows.filter(**labels) if labels.keys() <= set(rows.columns) else rows.clear()


def _one_cell(rows: pl.DataFrame, labels: Labels) -> pl.DataFrame:
    if rows["traffic_seed"].n_unique() < len(rows):
        raise ValueError(f"{dict(labels)} are the labels of several cells")
    return rows.sort("traffic_seed")


def values_of(rows: pl.DataFrame, metric: str) -> FloatArray:
    """Return a column, or `ERROR`, as an array, shape (n,)."""
    if metric == ERROR:
        return -1000.0 * rows["reward"].to_numpy().astype(np.float64)
    return rows[metric].to_numpy().astype(np.float64)


def values(rows: pl.DataFrame, labels: Labels, metric: str) -> FloatArray:
    """Return a column of a cell, or `ERROR`, for each traffic seed, shape (n_seeds,)."""
    return values_of(pick(rows, labels), metric)


def paired(rows: pl.DataFrame, *groups: tuple[str, Sequence[Labels]]) -> list[FloatArray]:
    """Return columns of groups of cells, all paired as `pick_paired` does.

    Args:
        rows: Rows of a study.
        *groups: A column, or `ERROR`, with the labels of cells.

    Returns:
        For each group an array (n_cells, n_traffic_seeds).

    Raises:
        UnmeasuredError, ValueError: See `pick_paired`.
    """
    found = iter(pick_paired(rows, *(labels for _, cells in groups for labels in cells)))
    return [np.stack([values_of(next(found), metric) for _ in cells]) for metric, cells in groups]


def mean(rows: pl.DataFrame, labels: Labels, metric: str) -> Interval:
    """Return the mean of a column of a cell over its traffic seeds, with its 95 % interval."""
    return mean_interval(values(rows, labels, metric))


def difference(rows: pl.DataFrame, labels: Labels, reference: Labels, metric: str) -> Interval:
    """Return by how much a cell exceeds a reference, paired by traffic and noise."""
    own, other = paired(rows, (metric, [labels]), (metric, [reference]))
    return mean_interval(own[0] - other[0])


def below(rows: pl.DataFrame, labels: Labels, reference: Labels, metric: str = ERROR) -> Interval:
    """Return by how much the mean error of a cell lies below that of a reference [%], paired.

    The interval is that of the difference over the mean of the reference.
    """
    own, other = paired(rows, (metric, [labels]), (metric, [reference]))
    scale, found = 100.0 / float(other.mean()), mean_interval(other[0] - own[0])
    return Interval(scale * found.mean, scale * found.low, scale * found.high, found.n)


def chi2(rows: pl.DataFrame, labels: Labels) -> list[float]:
    """Return the mean squares of errors over deviations, of densities and of speeds."""
    return [float(values(rows, labels, name).mean()) for name in HONESTY]


def chi2_text(rows: pl.DataFrame, labels: Labels) -> str:
    """Return `chi2` as text."""
    return ", ".join(f"{each:.2f}" for each in chi2(rows, labels))


def markdown(
    header: Sequence[str], rows: Iterable[Sequence[str]], first: str = "---", rest: str = ":-:"
) -> str:
    """Return a Markdown table, its first column and the rest with the given rules below them."""
    lines = [header, [first, *[rest] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


WIDEST = 6
"""Columns that a page has room for."""


def narrow(text: str) -> str:
    """Return a Markdown text with wide tables cut into some of `WIDEST` columns at most.

    They share the first column.
    """
    parts = []
    for part in text.split("\n\n"):
        lines = [line[2:-2].split(" | ") for line in part.split("\n")]
        n = len(lines[0])
        if part.startswith("| ") and n > WIDEST:
            cuts = np.array_split(np.arange(1, n), math.ceil((n - 1) / (WIDEST - 1)))
            tables = ([[line[0], *(line[i] for i in cut)] for line in lines] for cut in cuts)
            parts += [markdown(head, rows, *rule[:2]) for head, rule, *rows in tables]
        else:
            parts.append(part)
    return "\n\n".join(parts)


def grid(
    corner: str, rows: Sequence[Any], columns: Sequence[Any], entry: Callable[[Any, Any], str]
) -> str:
    """Return a Markdown table of what ``entry`` gives for each row and column.

    What was not measured is a dash.
    """
    return markdown(
        [corner, *map(str, columns)],
        [[str(row), *(cell(entry, row, column) for column in columns)] for row in rows],
    )


def table(
    corner: str, lines: Mapping[str, Any], columns: Mapping[str, Callable[[Any], str]]
) -> str:
    """Return a `grid` of what each column gives for the subject of each line."""
    return grid(corner, list(lines), list(columns), lambda name, head: columns[head](lines[name]))


def cell(entry: Callable[..., str], *arguments: Any) -> str:
    """Return what ``entry`` gives, and a dash where it was not measured."""
    try:
        return entry(*arguments)
    except UnmeasuredError:
        return "-"


def format_interval(interval: Interval) -> str:
    """Return a mean with its interval, three significant digits or two decimals each."""

    def digits(value: float) -> str:
        if 0.0 < abs(value) < 0.1:
            return f"{value:.2g}"
        return f"{value:.1f}" if abs(value) >= 100 else f"{value:.2f}"

    return f"{digits(interval.mean)} [{digits(interval.low)}, {digits(interval.high)}]"


def tenths(interval: Interval) -> str:
    """Return a mean with the ends of its interval, a decimal each."""
    return f"{interval.mean:.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def give_or_take(interval: Interval) -> str:
    """Return a mean and half the length of its interval, a decimal each."""
    return f"{interval.mean:.1f} ± {interval.half_width:.1f}"


def format_number(value: float) -> str:
    """Return three significant digits without an exponent."""
    return f"{float(f'{value:.3g}'):g}" if abs(value) < 1e5 else f"{value:,.0f}"


def format_range(values: Sequence[int]) -> str:
    """Return integers briefly, as their first and last where none is left out."""
    if list(values) == list(range(values[0], values[-1] + 1)):
        return f"{values[0]} to {values[-1]}"
    return ", ".join(map(str, values))
