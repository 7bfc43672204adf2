"""Replay: an estimator lives through an interval again, with what is known at its end.

A reading of an interval says something of every second of it. One state of the estimator is kept
for an interval, and what it was given since.
"""

from operator import getitem

import numpy as np

from dptse_env.estimators import Estimator, Measurement
from dptse_env.measurement.loops import LoopReadings
from dptse_env.release import Task
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.threads import EpisodeThreads


class Replay:
    """The present intervals of n episodes."""

    def __init__(
        self, loops: LoopReadings, estimator: Estimator, task: Task, threads: EpisodeThreads
    ) -> None:
        """Prepare for intervals of loops.

        Raises:
            ValueError: The estimator does not say what it remembers.
        """
        self._loops, self._estimator, self._threads = loops, estimator, threads
        self._kept = [np.empty_like(array) for array in estimator.memory]
        shape = loops.interval, estimator.n_episodes
        self._length = np.zeros(estimator.n_episodes, dtype=np.int64)
        self._inputs = np.empty((*shape, estimator.model.n_inputs))
        self._measured = Measurement(
            np.empty((*shape, task.n_channels), dtype=np.bool_),
            np.empty((*shape, task.n_channels, 2)),
            np.empty((*shape, task.n_channels, 2)),
            np.empty((*shape, task.n_cells)),
        )

    def begin(self, episodes: IntArray) -> None:
        """Begin an interval of episodes (k,) with the present state of the estimator."""
        for kept, array in zip(self._kept, self._estimator.memory, strict=True):
            kept[episodes] = array[episodes]
        self._length[episodes] = 0

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
        place = self._length[episodes], episodes
        self._inputs[place] = inputs
        for kept, array in zip(self._measured, measured, strict=True):
            kept[place] = array
        self._length[episodes] += 1
        intervals, rest = np.divmod(times, self._loops.interval)
        ending = rest == 0
        if ending.any():
            self._again(episodes[ending], traffic[ending], intervals[ending] - 1)

    def _again(self, episodes: IntArray, traffic: IntArray, intervals: IntArray) -> None:
        """Live through an interval of episodes again, with its readings, and begin the next."""
        for kept, array in zip(self._kept, self._estimator.memory, strict=True):
            array[episodes] = kept[episodes]
        said = self._loops.said(self._loops.read(traffic, intervals))
        length = self._length[episodes]  # that of the first one where an episode began within it
        for second in range(int(length.max())):
            rows = np.flatnonzero(second < length)
            which = episodes[rows]
            given = Measurement(*(array[second, which] for array in self._measured))
            given = self._loops.added(given, said.at(rows))
            inputs = self._inputs[second, which]
            self._threads.run(self._estimator.predict, which, inputs, getitem)
            self._threads.run(self._estimator.update, which, given, Measurement.at)
        self.begin(episodes)
