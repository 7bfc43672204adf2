"""The rows of the table, each the work of one child process."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

ESTIMATORS = ("ekf", "ukf", "enkf", "mhe", "random_walk")
SIZES = (1, 64, 1024)
FEW, ALL = 5, 15
"""Segments queried a step: the paper's number, and all of the mainline."""

HORIZON = 300
"""Length of an episode [s]; it starts anywhere in a record, so that a batch sees all of it."""

THREADS = 2
"""Threads of a measurement on "two cores"."""

LONGEST = 300.0  # [s] that a row may take, compiling its kernels included


@dataclass(frozen=True)
class Row:
    """The job of one child process.

    Attributes:
        name: Name for ``--rows``.
        work: ``module:function`` of this package.
        options: Keywords of the function.
        needs: Modules that it imports and that need not be installed.
    """

    name: str
    work: str
    options: dict[str, Any] = field(default_factory=dict)
    needs: tuple[str, ...] = ()

    @property
    def missing(self) -> str | None:
        """Description of missing modules, and how to get them; None where all are installed."""
        absent = [name for name in self.needs if importlib.util.find_spec(name) is None]
        install = "pip install 'dptse-env[benchmark]'"
        return f"{' and '.join(absent)} not installed: {install}" if absent else None


@dataclass(frozen=True)
class Sizes:
    """Traffic and bandwidths of a run.

    Attributes:
        traffic_seeds: Records behind the environments' rows.
        kept_seeds: Records behind the rows about memory.
        recorded_seeds: Scenarios that are recorded in one process while the clock runs.
        pooled_seeds: The same for recording in child processes.
        bandwidths: Numbers of segments queried.
    """

    traffic_seeds: str = "0:64"
    kept_seeds: str = "0:256"
    recorded_seeds: str = "0:2"
    pooled_seeds: str = "0:20"
    bandwidths: tuple[int, ...] = (FEW, ALL)


QUICK = Sizes("0:4", "0:8", "0:1", "0:2", (FEW,))


def vector_name(estimator: str, bandwidth: int, n: int) -> str:
    """Return the name of a vectorised row."""
    return f"vector-{estimator}-{bandwidth}-{n}"


def catalogue(sizes: Sizes) -> Iterator[Row]:
    """Yield all rows, in the order in which they run."""

    def env(estimator: str, bandwidth: int = FEW, **more: Any) -> dict[str, Any]:
        return {
            "preset": "PaperHighway",
            "estimator": estimator,
            "bandwidth": bandwidth,
            "parameters": "w99-3lane",
            "horizon": HORIZON,
            "random_start": True,
            "traffic_seeds": sizes.traffic_seeds,
            **more,
        }

    sumo = {"preset": "paper-highway", "traffic_seeds": sizes.recorded_seeds}
    pooled = {**sumo, "traffic_seeds": sizes.pooled_seeds, "workers": THREADS}
    yield Row("libsumo", "simulators:recording", sumo)
    yield Row("recording-processes", "simulators:processes", pooled)
    yield Row("sumo-rl", "sumo_rl_peer:intersection", needs=("sumo_rl", "sumo"))
    for estimator in ESTIMATORS:
        yield Row(f"scalar-{estimator}", "environments:scalar", env(estimator))
    for estimator in ("ekf", "ukf", "mhe"):
        options = env(estimator, backend="reference")
        yield Row(f"reference-{estimator}", "environments:scalar", options)
    for estimator in ("ekf", "ukf", "enkf", "mhe"):
        options = {"estimator": estimator, "bandwidth": FEW}
        yield Row(f"plain-{estimator}", "plain_loops:plain_loop", options)
    for mode, sizes_of_mode in (("sync", (8, 64)), ("async", (2, 4, 8, 16))):
        for n in sizes_of_mode:
            yield Row(f"{mode}-{n}", "environments:gymnasium_vector", env("ekf", n=n, mode=mode))
    for estimator in ESTIMATORS:
        for bandwidth in sizes.bandwidths:
            for n in SIZES:
                # A single episode has nothing to share out.
                options = env(estimator, bandwidth, n=n, threads=THREADS if n > 1 else 1)
                yield Row(vector_name(estimator, bandwidth, n), "environments:vector", options)
    parallel = env("ekf", n=1024, threads=THREADS)
    yield Row("vector-private", "environments:vector", {**parallel, "preset": "PrivateHighway"})
    yield Row("ppo", "learning:ppo", parallel, needs=("stable_baselines3", "torch"))
    for name, preset in (("memory-paper", "PaperHighway"), ("memory-private", "PrivateHighway")):
        options = env("ekf", n=1024, n_episodes=10_000, traffic_seeds=sizes.kept_seeds)
        yield Row(name, "memory:memory", {**options, "preset": preset})


def chosen(rows: Sequence[Row], patterns: Sequence[str]) -> list[Row]:
    """Return the rows that match any of ``patterns``; all of them if there are none.

    Raises:
        ValueError: A pattern matches no row.
    """
    for pattern in patterns:
        if not any(fnmatchcase(row.name, pattern) for row in rows):
            names = ", ".join(row.name for row in rows)
            raise ValueError(f"rows must be among {names}, or patterns as in ekf*; got {pattern!r}")
    return [
        row
        for row in rows
        if not patterns or any(fnmatchcase(row.name, pattern) for pattern in patterns)
    ]
