"""Replay: an estimator lives through an interval again, with what is known at its end.

A reading of an interval says something of every second of it. So the estimator's state is kept once
an interval, and what it was given since: inputs, and the numbers of the channels that were
observed. When the readings come, it goes back and takes them in each of these seconds.
"""

from __future__ import annotations

from operator import getitem
from typing import Any

import numpy as np

from dptse_env.estimators import Estimator, Measurement
from dptse_env.measurement.loops import LoopReadings
from dptse_env.release import Task
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.threads import EpisodeThreads

BLOCK = 1024
"""Measurements that are put together at a time; more of them cost memory, fewer of them time."""


class Replay:
    """The present interval of each of n episodes.

    `Estimator.innovations` stay those of what was released, and `Estimator.diverged` and
    `Estimator.fallback` say so if it happened in any second that was lived through again.

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
        shape, self._n_cells = (loops.interval, estimator.n_episodes), task.n_cells
        most = task.queries.most_queries + len(task.always)
        # np.zeros takes address space, not memory, until seconds are kept.
        self._inputs = np.zeros((*shape, estimator.model.n_inputs))
        self._observed = np.zeros((*shape, task.n_channels), dtype=np.bool_)
        self._numbers = np.zeros((2, *shape, most, 2))  # values and sigma of observed channels
        self._centre = np.zeros((*shape, task.n_cells)) if task.releases_flow else None

    @property
    def shared(self) -> tuple[Any, ...]:
        """What no episode changes, so that copies share it."""
        return self._loops, self._threads

    def begin(self, episodes: IntArray, times: IntArray) -> None:
        """Begin episodes (k,) at seconds of the record (k,), with the estimator's present state."""
        self._keep(episodes)
        self._first[episodes] = times % self._loops.interval

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
        """Keep what the estimator was given in a second, and replay the intervals that end.

        Args:
            episodes: Shape (k,).
            traffic: Index of each episode's traffic seed, shape (k,).
            times: Second of the record that has just been measured, shape (k,).
            inputs: The model's inputs of its prediction, shape (k, n_u).
            measured: The measurement that it was updated by.
        """
        second = (times - 1) % self._loops.interval
        self._inputs[second, episodes] = inputs
        self._observed[second, episodes] = measured.observed
        row, channel, slot = _slots(measured.observed)
        numbers = measured.values[row, channel], measured.sigma[row, channel]
        self._numbers[:, second[row], episodes[row], slot] = numbers
        if self._centre is not None:
            self._centre[second, episodes] = measured.centre
        ends = times % self._loops.interval == 0
        if ends.any():
            self._again(episodes[ends], traffic[ends], times[ends] // self._loops.interval - 1)

    def _again(self, episodes: IntArray, traffic: IntArray, intervals: IntArray) -> None:
        """Live through intervals of episodes again, with their readings, and begin the next."""
        order = np.argsort(self._first[episodes], kind="stable")
        episodes, traffic, intervals = episodes[order], traffic[order], intervals[order]
        first, estimator, k = self._first[episodes], self.estimator, len(episodes)
        innovations = estimator.innovations[episodes]
        diverged, fallback = estimator.diverged[episodes], estimator.fallback[episodes]
        for kept, array in zip(self._kept, estimator.memory, strict=True):
            array[episodes] = kept[episodes]
        said, size = self._loops.said(self._loops.read(traffic, intervals)), max(BLOCK // k, 1)
        for begin in range(first[0], self._loops.interval, size):
            seconds = np.arange(begin, min(begin + size, self._loops.interval))
            each = np.tile(np.arange(k), len(seconds))
            given = self._loops.added(self._measured(seconds, episodes), said.at(each))
            inputs = self._inputs[seconds[:, None], episodes]
            # Episodes that began within the interval join in later.
            for i, n in enumerate(np.searchsorted(first, seconds, "right").tolist()):
                live, own = episodes[:n], given.at(slice(i * k, i * k + n))
                self._threads.run(estimator.predict, live, inputs[i, :n], getitem)
                self._threads.run(estimator.update, live, own, Measurement.at)
                diverged[:n] |= estimator.diverged[live]
                fallback[:n] |= estimator.fallback[live]
        estimator.innovations[episodes] = innovations
        estimator.diverged[episodes], estimator.fallback[episodes] = diverged, fallback
        self._first[episodes] = 0
        self._keep(episodes)

    def _measured(self, seconds: IntArray, episodes: IntArray) -> Measurement:
        """Return what was measured in each of some seconds, one after the other, of episodes."""
        place, n_rows = (seconds[:, None], episodes), len(seconds) * len(episodes)
        observed = self._observed[place].reshape(n_rows, -1)
        row, channel, slot = _slots(observed)
        values, sigma = np.zeros((2, *observed.shape, 2))
        second, episode = np.divmod(row, len(episodes))
        at = seconds[second], episodes[episode], slot
        values[row, channel], sigma[row, channel] = self._numbers[(slice(None), *at)]
        if self._centre is None:  # a mean speed has none
            centre = np.full((n_rows, self._n_cells), np.nan)
        else:
            centre = self._centre[place].reshape(n_rows, -1)
        return Measurement(observed, values, sigma, centre)


def _slots(observed: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return row, channel and number in its row of each observed channel of (k, C)."""
    row, channel = np.nonzero(observed)
    return row, channel, np.arange(row.size) - np.searchsorted(row, row)
