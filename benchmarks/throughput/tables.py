"""The tables, as markdown and as CSV."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.throughput.results import Result, Results, best, rate_of, ratio
from benchmarks.throughput.rows import ESTIMATORS, FEW, SIZES, THREADS, vector_name
from benchmarks.throughput.targets import Target

NAMES = {"ekf": "EKF", "ukf": "UKF", "enkf": "EnKF", "mhe": "MHE", "random_walk": "random walk"}
PEERS = {"ekf": "filterpy", "ukf": "filterpy", "enkf": "filterpy", "mhe": "qpsolvers"}
NONE = "–"


def number(value: float | None, form: str = "{:,.0f}") -> str:
    """Print a figure, or a dash where there is none."""
    return NONE if value is None else form.format(value)


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table; the first column is text, the others are numbers."""
    rule = [":--", *["--:"] * (len(header) - 1)]
    rows = [header, rule, *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def rate(result: Result, arm: str) -> str:
    """Return a median rate with its spread, or what kept it from being measured."""
    median, spread = result.rate(arm), result.spread(arm)
    if median is None or spread is None:
        return result.problem or NONE
    return f"{median:,.0f} ± {spread:.0%}"


def memory(result: Result) -> str:
    """Return the peak and the libraries' share of it."""
    if result.peak is None:
        return NONE
    return number(result.peak) + (f" ({number(result.libraries)})" if result.libraries else "")


class Way(NamedTuple):
    """One way to get environment steps.

    Attributes:
        title: What the table calls it.
        one: Row and arm on one core; None where there is none.
        two: Row and arm on two cores; None where there is none.
    """

    title: str
    one: tuple[str, str] | None
    two: tuple[str, str] | None = None


def ways(results: Results) -> Iterator[Way]:
    """Yield the lines of the short table."""
    pool = ("recording-processes", "several")
    yield Way("libsumo alone, simulated seconds", ("libsumo", "bare"))
    yield Way("recording to disk", ("libsumo", "recording"), pool)
    yield Way("sumo-rl, single intersection, 5 s a step", ("sumo-rl", "environment"))
    for name, peer in PEERS.items():
        yield Way(f"{NAMES[name]} of {peer}, alone in a loop", (f"plain-{name}", "estimator"))
    for name in ("ekf", "ukf", "mhe"):
        row = f"reference-{name}"
        yield Way(f"one episode, {NAMES[name]} of {PEERS[name]}", (row, "environment"))
    for name in ESTIMATORS:
        yield Way(f"one episode, {NAMES[name]}", (f"scalar-{name}", "environment"))
    for row in quickest(results, "sync-"):
        title = f"SyncVectorEnv of {row.removeprefix('sync-')}, EKF"
        yield Way(title, (row, "environment"))
    for row in quickest(results, "async-"):
        title = f"AsyncVectorEnv of {row.removeprefix('async-')}, EKF"
        yield Way(title, None, (row, "environment"))
    for name in ESTIMATORS:
        row = vector_name(name, FEW, 1024)
        yield Way(f"**1,024 episodes, {NAMES[name]}**", (row, "one thread"), (row, "threads"))
    row = "vector-private"
    yield Way("**the same on PrivateHighway, EKF**", (row, "one thread"), (row, "threads"))
    yield Way("PPO on 1,024 episodes, EKF, end to end", None, ("ppo", "PPO"))


def quickest(results: Results, prefix: str) -> list[str]:
    """Return the name of the best row that starts so, or all of them where none has a result."""
    found = best(results, prefix)
    return [found[0]] if found else [name for name in results if name.startswith(prefix)]


def summary(results: Results) -> str:
    """Return the short table: a line for each way to get environment steps."""
    header = ("steps a second", "one core", "two cores", "a core, times libsumo",
              "memory (libraries) [MiB]")  # fmt: skip
    bare = rate_of(results, "libsumo", "bare")
    lines = (_line(results, way, bare) for way in ways(results))
    return markdown(header, (line for line in lines if line))


def _line(results: Results, way: Way, bare: float | None) -> list[str]:
    """Return a line of the short table; an empty one for rows that were not asked for."""
    cells, result, a_core = [], None, None
    for place, cores in ((way.one, 1), (way.two, THREADS)):
        if place is None or place[0] not in results:
            cells.append(NONE)
            continue
        own = results[place[0]]
        cells.append(rate(own, place[1]))
        if result is None:
            result = own
            # sumo-rl's steps are several seconds long: seconds are what compares.
            seconds = result.note("simulated_seconds") or 1.0
            median = own.rate(place[1])
            a_core = None if median is None else median * seconds / cores
    if result is None:
        return []
    times = ratio(a_core, bare)
    form = "{:,.0f}" if times is not None and times >= 10.0 else "{:.2g}"
    return [way.title, *cells, number(times, form), memory(result)]


def vectorised(results: Results) -> str:
    """Return the table of the native vectorisation."""
    header = (
        "estimator, segments, episodes", "one core", "bare estimator", "share of it", "two cores",
        "gain", "reset [µs an episode]", "memory (libraries) [MiB]",
    )  # fmt: skip
    bandwidths = sorted(set(_bandwidths(results)))
    named = [
        (f"{NAMES[name]}, {bandwidth}, {n:,}", results.get(vector_name(name, bandwidth, n)), n)
        for name in ESTIMATORS
        for bandwidth in bandwidths
        for n in SIZES
    ]
    named.append(("EKF, 5, 1,024, PrivateHighway", results.get("vector-private"), 1024))
    lines = []
    for title, result, n in named:
        if result is None:
            continue
        reset = result.note("reset_seconds")
        lines.append(
            [
                title,
                rate(result, "one thread"),
                number(result.rate("kernel")),
                number(result.share("one thread", "kernel"), "{:.0%}"),
                number(result.rate("threads")),
                number(result.share("threads", "one thread"), "{:.2f}"),
                number(None if reset is None else reset / n * 1e6),
                memory(result),
            ]
        )
    return markdown(header, lines)


def _bandwidths(results: Results) -> Iterator[int]:
    for name, result in results.items():
        if name.startswith("vector-"):
            yield result.row.options["bandwidth"]


def others(results: Results) -> str:
    """Return every arm that is not of the native vectorisation."""
    header = ("row", "rate [1/s]", "memory (libraries) [MiB]")
    lines = [
        [f"{name}: {arm}", rate(result, arm), memory(result)]
        for name, result in results.items()
        if not name.startswith("vector-")
        for arm in (result.repeats[0].arms if result.repeats else [NONE])
    ]
    return markdown(header, lines)


def shares(results: Results, row: str, title: str) -> str:
    """Return the notes of a row, shares of its time; nothing if it was not measured."""
    if row not in results or not results[row].repeats:
        return ""
    # A profile may name other functions in another repeat: only what all of them name.
    named = [name for name in results[row].repeats[0].notes
             if all(name in one.notes for one in results[row].repeats)]  # fmt: skip
    lines = [(name, number(results[row].note(name), "{:.0%}")) for name in named]
    return markdown((title, "share"), lines)


def judged(lines: Iterable[Target]) -> str:
    """Return the targets and their verdicts."""
    header = ("target", "bound", "measured", "")
    return markdown(
        header,
        (
            [
                target.what,
                ("≥ " if target.is_floor else "< ") + target.form.format(target.bound),
                number(target.measured, target.form),
                target.verdict,
            ]
            for target in lines
        ),
    )


def problems(results: Results) -> str:
    """Return the rows without a result, a line each."""
    return "".join(f"- {n}: {r.problem}\n" for n, r in results.items() if r.problem)


def disturbance(results: Results) -> str:
    """Return how much of a core single-threaded work had: below one if others worked, too."""
    cores = [
        samples.cores
        for result in results.values()
        for one in result.repeats
        for arm, samples in one.arms.items()
        if arm in ("bare", "recording", "one thread", "kernel") and samples.cores is not None
    ]
    if not cores:
        return ""
    return (
        f"Single-threaded work had {statistics.median(cores):.2f} of a core in the median and "
        f"{min(cores):.2f} at least, in {len(cores)} measurements.\n"
    )


def write_csv(path: Path, results: Results) -> None:
    """Write a line for each repeat of each arm."""
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(
            ["row", "arm", "repeat", "median", "lowest", "highest", "turns", "cores",
             "peak_mib", "libraries_mib", "problem"]
        )  # fmt: skip
        for name, result in results.items():
            for repeat, one in enumerate(result.repeats):
                for arm, samples in one.arms.items():
                    rates = samples.rates
                    figures = [statistics.median(rates), min(rates), max(rates)]
                    lines.writerow(
                        [name, arm, repeat, *(f"{r:.1f}" for r in figures), len(rates),
                         number(samples.cores, "{:.3f}"), number(one.peak, "{:.1f}"),
                         number(one.libraries, "{:.1f}"), ""]
                    )  # fmt: skip
            if result.problem:
                lines.writerow([name, *[""] * 9, result.problem])
