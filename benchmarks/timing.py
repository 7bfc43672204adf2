"""Rows of a table of times, measured in turns so that all of them meet the same weather."""

from __future__ import annotations

import statistics
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.replay import Replay
from dptse_env.estimators import make_estimator


class Row(ABC):
    """One way to carry out the steps of an estimator.

    Attributes:
        estimator: Which estimator.
        label: Which way.
        n_episodes: Episodes that a step is taken in.
    """

    n_episodes = 1

    def __init__(self, estimator: str, label: str) -> None:
        """Name the row."""
        self.estimator, self.label = estimator, label
        self._seconds: dict[int, list[float]] = defaultdict(list)

    @abstractmethod
    def begin(self) -> None:
        """Go to the beginning of the replay."""

    @abstractmethod
    def run(self, steps: range) -> Iterator[tuple[int, float]]:
        """Take some of the steps; yield the index and the time [s] of each that was taken."""

    def measure(self, steps: range) -> None:
        """Run and remember."""
        for k, seconds in self.run(steps):
            self._seconds[k].append(seconds)

    def forget(self) -> None:
        """Drop what was measured so far."""
        self._seconds.clear()

    @property
    def microseconds(self) -> list[float]:
        """Time of each step and episode [us], the median over the passes."""
        scale = 1e6 / self.n_episodes
        return [scale * statistics.median(times) for times in self._seconds.values()]

    @property
    def mean(self) -> float:
        """Mean over the steps [us]."""
        return statistics.fmean(self.microseconds)

    @property
    def percentile_95(self) -> float:
        """95th percentile over the steps [us]."""
        return float(np.percentile(self.microseconds, 95))


class Steps(Row):
    """An estimator of the package on a replay: `predict`, then `update`.

    Attributes:
        reading: The time of `estimate` after each step, a row of its own.
    """

    def __init__(self, estimator: str, backend: str, label: str, replay: Replay) -> None:
        """Build the estimator."""
        super().__init__(estimator, label)
        self.replay, self.n_episodes = replay, len(replay.start)
        self.own: Any = make_estimator(
            estimator, backend, replay.model, self.n_episodes, replay.settings
        )
        self.reading = Reading(estimator, "estimate()", self.n_episodes)
        self._everyone = np.arange(self.n_episodes)
        self._passed_on = 0
        self._diverged = 0

    def begin(self) -> None:
        """Start all episodes over, with the same random streams in every pass."""
        streams = [np.random.default_rng([1, i]) for i in range(self.n_episodes)]
        self.own.reset(self._everyone, self.replay.start, streams)
        self._passed_on = getattr(self.own, "n_passed_on", 0)
        self._diverged = 0

    def forget(self) -> None:
        """Drop what was measured so far, the readings too."""
        super().forget()
        self.reading.forget()

    @property
    def n_passed_on(self) -> int:
        """Programs of the last pass that went to the general solver; 0 but for the MHE."""
        return int(getattr(self.own, "n_passed_on", 0)) - self._passed_on

    @property
    def n_diverged(self) -> int:
        """Steps of the last pass at which an episode diverged."""
        return self._diverged

    def run(self, steps: range) -> Iterator[tuple[int, float]]:
        """Take all steps."""
        own, everyone, replay, clock = self.own, self._everyone, self.replay, time.perf_counter
        for k in steps:
            inputs, observed, values = replay.inputs[k], replay.observed[k], replay.values[k]
            start = clock()
            own.predict(everyone, inputs)
            own.update(everyone, observed, values, replay.sigma)
            updated = clock()
            own.estimate()
            self.reading.add(k, clock() - updated)
            self._diverged += int(own.diverged.sum())
            yield k, updated - start


class Reading(Row):
    """Times that another row takes on its way."""

    def __init__(self, estimator: str, label: str, n_episodes: int) -> None:
        """Name the row."""
        super().__init__(estimator, label)
        self.n_episodes = n_episodes

    def add(self, step: int, seconds: float) -> None:
        """Remember a time."""
        self._seconds[step].append(seconds)

    def begin(self) -> None:
        """Nothing to go back to."""

    def run(self, steps: range) -> Iterator[tuple[int, float]]:
        """Nothing to run."""
        yield from ()


def interleave(rows: Sequence[Row], n_steps: int, block: int, passes: int) -> None:
    """Measure rows block by block in turns, `passes` times through all steps."""
    for row in rows:  # compiles, fills caches
        row.begin()
        row.measure(range(min(2, n_steps)))
        row.forget()
    for _ in range(passes):
        for row in rows:
            row.begin()
        for first in range(0, n_steps, block):
            for row in rows:
                row.measure(range(first, min(first + block, n_steps)))


def per_call(run: Callable[[], Any], calls: int, repeats: int) -> float:
    """Return the median time of a call [us]; `run` makes `calls` of them."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) / calls)
    return statistics.median(times) * 1e6
