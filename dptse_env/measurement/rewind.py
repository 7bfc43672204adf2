"""Rewind: an estimator goes through an interval again, with what is known at its end.

A reading is of a whole interval. So the estimator's state is kept once an interval, and what it was
given since: inputs, and the numbers of the channels that were observed. When the readings come, it
goes back to that state, and takes them in some seconds, by what it estimated of these before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators import Estimator, Measurement
from dptse_env.measurement.loops import LoopReadings
from dptse_env.release import Task
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, kernel
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.threads import EpisodeThreads

BLOCK = 1024
"""Measurements that are put together at a time; more of them cost memory, fewer of them time."""


class Rewind:
    """The present interval of each of n episodes.

    `Estimator.innovations` stay those of what was released, and `Estimator.diverged` and
    `Estimator.fallback` say so if it happened in any second of the second pass.

    Attributes:
        estimator: The estimator, which it takes back and forward again.
    """

    def __init__(
        self, loops: LoopReadings, estimator: Estimator, task: Task, threads: EpisodeThreads
    ) -> None:
        """Prepare for intervals of loops.

        Raises:
            ValueError: The estimator does not say what it remembers, or gives copies of it.
        """
        self.estimator, self._loops, self._threads = estimator, loops, threads
        own, again = estimator.memory, estimator.memory
        if any(a.size and not np.may_share_memory(a, b) for a, b in zip(own, again, strict=True)):
            name = name_of_class(estimator)
            raise ValueError(f"estimator must return its own arrays as _memory, got {name}")
        self._kept = [np.empty_like(array) for array in own]
        self._first = np.zeros(estimator.n_episodes, dtype=np.int64)
        shape, most = (loops.interval, estimator.n_episodes), task.queries.most_queries
        numbers = (*shape, most + len(task.always), 2)
        beside = len(loops.seconds), estimator.n_episodes, loops.segments.size, 2
        self._estimated = np.full(beside, np.nan)
        # np.zeros takes address space, not memory, until seconds are kept.
        log = Log(
            inputs=np.zeros((*shape, estimator.model.n_inputs)),
            observed=np.zeros((*shape, task.n_channels), dtype=np.bool_),
            values=np.zeros(numbers),
            sigma=np.zeros(numbers),
            centre=np.zeros((*shape, task.n_cells if task.releases_flow else 0)),
            n_cells=task.n_cells,
        )
        self._log = Bundle(log)

    @property
    def shared(self) -> tuple[Any, ...]:
        """Parts that no episode changes, so that copies share them."""
        return self._loops, self._threads

    def begin(self, episodes: IntArray, times: IntArray) -> None:
        """Begin episodes (k,) at seconds of the record (k,), with the estimator's present state."""
        self._keep(episodes)
        self._first[episodes] = times % self._loops.interval
        self._estimated[:, episodes] = np.nan

    def _keep(self, episodes: IntArray) -> None:
        for kept, array in zip(self._kept, self.estimator.memory, strict=True):
            kept[episodes] = array[episodes]

    def follow(
        self,
        episodes: IntArray,
        traffic: IntArray,
        times: IntArray,
        inputs: FloatArray,
        measured: Measurement,
    ) -> None:
        """Keep what the estimator was given in a second, and rewind where an interval ends.

        Args:
            episodes: Shape (k,).
            traffic: Index of each episode's traffic seed, shape (k,).
            times: Second of the record that has just been measured, shape (k,).
            inputs: The model's inputs of its prediction, shape (k, n_u).
            measured: The measurement that it was updated by.
        """
        seconds = (times - 1) % self._loops.interval
        keep(self._log, seconds, episodes, inputs, measured)
        row, second = np.nonzero(seconds[:, None] == self._loops.seconds)
        if row.size:
            estimate = self.estimator.estimate().at(episodes[row])
            found = np.stack([estimate.density, estimate.speed], axis=-1)
            self._estimated[second, episodes[row]] = found[:, self._loops.segments]
        ends = times % self._loops.interval == 0
        if ends.any():
            self._threads.run(self._again, episodes[ends], (traffic[ends], times[ends]), _block_of)

    def _again(self, episodes: IntArray, place: tuple[IntArray, IntArray]) -> None:
        """Go through the interval that ends of episodes (k,) again, with its readings.

        Args:
            episodes: Shape (k,).
            place: Index of their traffic seeds and second of the record, shape (k,) each.
        """
        order = np.argsort(self._first[episodes], kind="stable")
        episodes, (traffic, times) = episodes[order], (each[order] for each in place)
        first, estimator, k = self._first[episodes], self.estimator, len(episodes)
        innovations = estimator.innovations[episodes]
        diverged, fallback = estimator.diverged[episodes], estimator.fallback[episodes]
        for kept, array in zip(self._kept, estimator.memory, strict=True):
            array[episodes] = kept[episodes]
        said = self._loops.said_until(traffic, times)
        told = self._loops.told(said, self._estimated[:, episodes])
        interval, size = self._loops.interval, max(BLOCK // k, 1)
        for begin in range(first[0], interval, size):
            seconds = np.arange(begin, min(begin + size, interval))
            inputs, observed, values, sigma, centre = recall(self._log, seconds, episodes)
            measured = Measurement(observed, values, sigma, centre)
            given = self._loops.added(measured, told, seconds)
            # Episodes that began within the interval join in later.
            for i, n in enumerate(np.searchsorted(first, seconds, "right").tolist()):
                live = episodes[:n]
                estimator.predict(live, inputs[i, :n])
                estimator.update(live, given.at(slice(i * k, i * k + n)))
                diverged[:n] |= estimator.diverged[live]
                fallback[:n] |= estimator.fallback[live]
        estimator.innovations[episodes] = innovations
        estimator.diverged[episodes], estimator.fallback[episodes] = diverged, fallback
        self._first[episodes] = 0
        self._keep(episodes)


def _block_of(place: tuple[IntArray, IntArray], block: slice) -> tuple[IntArray, IntArray]:
    traffic, times = place
    return traffic[block], times[block]


class Log(NamedTuple):
    """Inputs and measurements of the T seconds of the present interval of n episodes.

    Slots have the channels that were observed, one after the other.
    """

    inputs: FloatArray  # (T, n, n_u)
    observed: BoolArray  # (T, n, C)
    values: FloatArray  # (T, n, slots, 2)
    sigma: FloatArray  # (T, n, slots, 2)
    centre: FloatArray  # (T, n, cells), without cells where mean speeds are released
    n_cells: int  # of a measurement


@kernel
def keep(
    bundle: Any, seconds: IntArray, episodes: IntArray, inputs: FloatArray, measured: Measurement
) -> None:
    """Write down what was given in seconds of the interval (k,) of episodes (k,)."""
    (log,) = bundle.parts
    for k in range(episodes.size):
        t, e, slot = seconds[k], episodes[k], 0
        for i in range(log.inputs.shape[2]):
            log.inputs[t, e, i] = inputs[k, i]
        for i in range(log.centre.shape[2]):
            log.centre[t, e, i] = measured.centre[k, i]
        for c in range(log.observed.shape[2]):
            log.observed[t, e, c] = measured.observed[k, c]
            if measured.observed[k, c]:
                if slot == log.values.shape[2]:
                    raise ValueError("more channels were observed than the bandwidth pays for")
                for j in range(2):
                    log.values[t, e, slot, j] = measured.values[k, c, j]
                    log.sigma[t, e, slot, j] = measured.sigma[k, c, j]
                slot += 1


@kernel
def recall(
    bundle: Any, seconds: IntArray, episodes: IntArray
) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray, FloatArray]:
    """Return inputs (m, k, n_u) of m seconds of k episodes, and the fields of a `Measurement`.

    These have m k rows, second by second; what was not observed is 0.
    """
    (log,) = bundle.parts
    m, n, C = seconds.size, episodes.size, log.observed.shape[2]
    inputs, centre = np.empty((m, n, log.inputs.shape[2])), np.full((m * n, log.n_cells), np.nan)
    observed = np.zeros((m * n, C), dtype=np.bool_)
    values, sigma = np.zeros((m * n, C, 2)), np.zeros((m * n, C, 2))
    for i in range(m):
        for k in range(n):
            t, e, row, slot = seconds[i], episodes[k], i * n + k, 0
            for j in range(inputs.shape[2]):
                inputs[i, k, j] = log.inputs[t, e, j]
            for j in range(log.centre.shape[2]):
                centre[row, j] = log.centre[t, e, j]
            for c in range(C):
                observed[row, c] = log.observed[t, e, c]
                if observed[row, c]:
                    for j in range(2):
                        values[row, c, j] = log.values[t, e, slot, j]
                        sigma[row, c, j] = log.sigma[t, e, slot, j]
                    slot += 1
    return inputs, observed, values, sigma, centre
