"""filterpy and qpsolvers in a plain loop over the steps of one episode, the estimator alone."""

from __future__ import annotations

import numpy as np

from benchmarks.peers import FilterPeer
from benchmarks.replay import recorded
from benchmarks.throughput.measure import Measured, Samples, resident
from benchmarks.timing import Row, Steps, interleave

BLOCK, BLOCKS = 25, 8


def plain_loop(_seconds: float, estimator: str, bandwidth: int) -> Measured:
    """Measure filterpy's filter, or for the MHE its program assembled and solved by piqp."""
    replay = recorded("w99-3lane", (0,), 1, bandwidth, BLOCK * BLOCKS)
    loaded = resident()
    row: Row
    if estimator == "mhe":
        row = Steps(estimator, "reference", "reference", replay)
    else:
        row = FilterPeer(estimator, replay, BLOCK)
    # The MHE's steps take some 30 ms each, and a filter takes three of each block.
    interleave([row], replay.n_steps, BLOCK, 1 if estimator == "mhe" else 3)
    blocks = np.array_split(np.array(row.microseconds), BLOCKS)
    rates = [float(1e6 / block.mean()) for block in blocks]
    return Measured({"estimator": Samples(rates)}, resident("VmHWM"), loaded)
