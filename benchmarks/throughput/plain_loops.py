"""filterpy and qpsolvers in a plain loop over the steps of one episode, the estimator alone."""

from __future__ import annotations

from benchmarks.peers import FilterPeer
from benchmarks.replay import recorded
from benchmarks.steps import Row, Steps, step_times
from benchmarks.throughput.measure import Measured, Samples, resident

BLOCK, BLOCKS = 25, 8


def plain_loop(_seconds: float, estimator: str, bandwidth: int) -> Measured:
    """Measure filterpy's filter, or for the MHE its program assembled and solved by piqp."""
    replay = recorded("w99-3lane", (0,), 1, bandwidth, BLOCK * BLOCKS)
    loaded, is_mhe = resident(), estimator == "mhe"
    row: Row = (
        Steps(estimator, "reference", replay) if is_mhe else FilterPeer(estimator, replay, BLOCK)
    )
    # The MHE's steps take some 30 ms each, and a filter takes three of each block.
    times = step_times({"estimator": row}, BLOCK * BLOCKS, BLOCK, 1 if is_mhe else 3)["estimator"]
    return Measured({"estimator": Samples((1e6 / times).tolist())}, resident("VmHWM"), loaded)
