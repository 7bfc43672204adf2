"""The tables, as Markdown and as CSV."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from agents import tables
from agents.figures import LABELS
from agents.files import write_csv as write_rows
from benchmarks.throughput.results import Result, Results, best, find
from benchmarks.throughput.rows import ESTIMATORS, FEW, SIZES, THREADS, vector_name

PEERS = {"ekf": "filterpy", "ukf": "filterpy", "enkf": "filterpy", "mhe": "qpsolvers"}
SECONDS = {"sumo-rl": 5.0}
"""Simulated seconds of a step, where it is not one [s]."""
NONE = "–"

Place = tuple[str, str]
"""A row and an arm of it."""


def number(value: float | None, form: str = "{:,.0f}") -> str:
    """Return a figure as text, or a dash where there is none."""
    return NONE if value is None or math.isnan(value) else form.format(value)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; the first column is text, the others are numbers."""
    return tables.markdown(header, rows, ":--", "--:")


def rate(result: Result, arm: str) -> str:
    """Return a median rate with its spread, or the reason why there is none."""
    if not result.rates(arm):
        return result.problem or NONE
    return f"{result.rate(arm):,.0f} ± {result.spread(arm):.0%}"


def memory(result: Result) -> str:
    """Return the peak and the libraries' share of it."""
    share = "" if math.isnan(result.libraries) else f" ({number(result.libraries)})"
    return number(result.peak) + share


def implementations(results: Results) -> Iterator[tuple[str, Place | None, Place | None]]:
    """Yield the lines of the short table: title, and places on one core and on two cores."""
    pool = ("recording-processes", "several")
    yield "libsumo alone, simulated seconds", ("libsumo", "bare"), None
    yield "recording to disk", ("libsumo", "recording"), pool
    yield "sumo-rl, single intersection, 5 s a step", ("sumo-rl", "environment"), None
    for name, peer in PEERS.items():
        yield f"{LABELS[name]} of {peer}, alone in a loop", (f"plain-{name}", "estimator"), None
    for name in ("ekf", "ukf", "mhe"):
        place = f"reference-{name}", "environment"
        yield f"one episode, {LABELS[name]} of {PEERS[name]}", place, None
    for name in ESTIMATORS:
        yield f"one episode, {LABELS[name]}", (f"scalar-{name}", "environment"), None
    for row in quickest(results, "sync-"):
        title = f"SyncVectorEnv of {row.removeprefix('sync-')}, EKF"
        yield title, (row, "environment"), None
    for row in quickest(results, "async-"):
        title = f"AsyncVectorEnv of {row.removeprefix('async-')}, EKF"
        yield title, None, (row, "environment")
    for name in ESTIMATORS:
        row = vector_name(name, FEW, 1024)
        yield f"**1,024 episodes, {LABELS[name]}**", (row, "one thread"), (row, "threads")
    row = "vector-private"
    yield "**the same on PrivateHighway, EKF**", (row, "one thread"), (row, "threads")
    yield "PPO on 1,024 episodes, EKF, end to end", None, ("ppo", "PPO")


def quickest(results: Results, prefix: str) -> list[str]:
    """Return the name of the best row that starts so, or all of them where none has a result."""
    found = best(results, prefix)
    return [found] if found else [name for name in results if name.startswith(prefix)]


def summary(results: Results) -> str:
    """Return the short table: a line for each way to get environment steps."""
    header = ("steps a second", "one core", "two cores", "a core, times libsumo",
              "memory (libraries) [MiB]")  # fmt: skip
    bare, rows = find(results, "libsumo").rate("bare"), []
    for title, *places in implementations(results):
        cells = [rate(find(results, place[0]), place[1]) if place else NONE for place in places]
        for place, n_cores in zip(places, (1, THREADS), strict=True):
            if place and place[0] in results:
                result = results[place[0]]
                simulated = result.rate(place[1]) * SECONDS.get(place[0], 1.0)
                times = simulated / n_cores / bare
                form = "{:,.0f}" if times >= 10.0 else "{:.2g}"
                rows.append([title, *cells, number(times, form), memory(result)])
                break
    return markdown(header, rows)


def vectorised(results: Results) -> str:
    """Return the table of the native vectorisation."""
    header = (
        "estimator, segments, episodes", "one core", "bare estimator", "share of it", "two cores",
        "gain", "reset [µs an episode]", "memory (libraries) [MiB]",
    )  # fmt: skip
    rows = [found.row for name, found in results.items() if name.startswith("vector-")]
    named = {
        vector_name(name, bandwidth, n): (f"{LABELS[name]}, {bandwidth}, {n:,}", n)
        for name in ESTIMATORS
        for bandwidth in sorted({row.options["bandwidth"] for row in rows})
        for n in SIZES
    }
    named["vector-private"] = ("EKF, 5, 1,024, PrivateHighway", 1024)
    lines = []
    for name, (title, n) in named.items():
        if name in results:
            result = results[name]
            figures = (
                number(result.rate("kernel")),
                number(result.share("one thread", "kernel"), "{:.0%}"),
                number(result.rate("threads")),
                number(result.share("threads", "one thread"), "{:.2f}"),
                number(result.note("reset_seconds") / n * 1e6),
            )
            lines.append([title, rate(result, "one thread"), *figures, memory(result)])
    return markdown(header, lines)


def remaining(results: Results) -> str:
    """Return every arm that is not of the native vectorisation."""
    header = ("row", "rate [1/s]", "memory (libraries) [MiB]")
    lines = [
        [f"{name}: {arm}", rate(result, arm), memory(result)]
        for name, result in results.items()
        if not name.startswith("vector-")
        for arm in (result.repeats[0].arms if result.repeats else [NONE])
    ]
    return markdown(header, lines)


def write_csv(path: Path, results: Results) -> None:
    """Write a line for each repeat of each arm."""
    columns = ["row", "arm", "repeat", "median", "lowest", "highest", "turns", "cores", "peak_mib",
               "libraries_mib", "problem"]  # fmt: skip

    def rows() -> Iterator[list[Any]]:
        for name, result in results.items():
            for repeat, measured in enumerate(result.repeats):
                for arm, samples in measured.arms.items():
                    rates = samples.rates
                    figures = [statistics.median(rates), min(rates), max(rates)]
                    memories = [
                        number(measured.peak, "{:.1f}"),
                        number(measured.libraries, "{:.1f}"),
                    ]
                    yield [name, arm, repeat, *(f"{figure:.1f}" for figure in figures), len(rates),
                           number(samples.cores, "{:.3f}"), *memories, ""]  # fmt: skip
            if result.problem:
                yield [name, *[""] * 9, result.problem]

    write_rows(path, columns, rows())
