"""Steps of estimators on a replay, measured in turns, block by block."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from benchmarks.replay import Replay
from benchmarks.throughput.measure import take_turns
from dptse_env.estimators import Measurement, make_estimator
from dptse_env.utils.arrays import FloatArray

REFERENCES = ("ekf", "ukf", "mhe")
"""Estimators with a reference backend: filterpy's filters, and qpsolvers with piqp."""


class Row(Protocol):
    """An implementation of an estimator that follows a replay."""

    def begin(self, block: range) -> None:
        """Prepare for the steps of a block, off the clock."""

    def take(self) -> int:
        """Take steps of the block; return their number, over all episodes."""


class Steps:
    """An estimator of the package: `predict`, then `update`, in every step of a block."""

    def __init__(self, estimator: str, backend: str, replay: Replay) -> None:
        """Make the estimator."""
        self._episodes, self._replay, self._block = np.arange(len(replay.start)), replay, range(0)
        self._estimator: Any = make_estimator(
            estimator, backend, replay.model, len(replay.start), replay.settings
        )
        self._measured = [
            Measurement.of(replay.model, observed, values, replay.sigma)
            for observed, values in zip(replay.observed, replay.values, strict=True)
        ]

    def begin(self, block: range) -> None:
        """See `Row.begin`; the first block starts over, with the same random streams each time."""
        self._block = block
        if block.start == 0:
            streams = [np.random.default_rng([1, i]) for i in self._episodes]
            self._estimator.reset(self._episodes, self._replay.start, streams)

    def take(self) -> int:
        """See `Row.take`."""
        episodes, replay = self._episodes, self._replay
        for k in self._block:
            self._estimator.predict(episodes, replay.inputs[k])
            self._estimator.update(episodes, self._measured[k])
        return len(self._block) * len(episodes)


def step_times(
    rows: Mapping[str, Row], n_steps: int, block: int, passes: int
) -> dict[str, FloatArray]:
    """Measure rows in turns, `passes` times through all steps.

    Args:
        rows: What to measure, by name.
        n_steps: Steps of the replay to follow.
        block: Steps of one turn.
        passes: Times that the rows go through the steps.

    Returns:
        By row, the time of a step of an episode in each block, median over the passes [us].
    """
    blocks = [range(first, min(first + block, n_steps)) for first in range(0, n_steps, block)]
    # The first round compiles and fills caches.
    rounds = iter([range(min(2, n_steps)), *blocks * passes])

    def prepare() -> None:
        following = next(rounds)
        for row in rows.values():
            row.begin(following)

    work = {name: row.take for name, row in rows.items()}
    arms = take_turns(work, 0.0, prepare, least=1 + len(blocks) * passes)
    rates = {name: np.array(arms[name].rates[1:]).reshape(passes, -1) for name in rows}
    return {name: np.median(1e6 / table, axis=0) for name, table in rates.items()}
