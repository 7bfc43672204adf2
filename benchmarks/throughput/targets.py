"""What the environment is meant to reach, and whether it does."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from benchmarks.throughput.results import Results, best, rate_of, ratio
from benchmarks.throughput.rows import FEW, vector_name

GIB = 1024.0
FLAT = 16.0  # [MiB] that ten thousand episodes may add


class Target(NamedTuple):
    """One line: a figure and the bound that it is held against.

    Attributes:
        what: The figure.
        bound: The bound.
        is_floor: Whether the figure must be at least the bound; else it must be below it.
        measured: The figure; None where a row that it needs was not measured.
        form: How to print both.
    """

    what: str
    bound: float
    is_floor: bool
    measured: float | None
    form: str

    @property
    def verdict(self) -> str:
        """Say ``met``, ``missed`` or ``not measured``."""
        if self.measured is None:
            return "not measured"
        met = self.measured >= self.bound if self.is_floor else self.measured < self.bound
        return "met" if met else "missed"


def targets(results: Results) -> Iterator[Target]:
    """Yield each target with its figure, all from one run."""

    def floor(what: str, bound: float, measured: float | None, form: str = "{:,.0f}") -> Target:
        return Target(what, bound, True, measured, form)

    name = vector_name("ekf", FEW, 1024)
    ekf = rate_of(results, name, "one thread")
    share = results[name].share("one thread", "kernel") if name in results else None
    yield floor("1,024 episodes, EKF, one core: share of the bare estimator", 0.6, share, "{:.0%}")
    yield floor("the same: steps a second", 25_000, ekf)
    bare = rate_of(results, "libsumo", "bare")
    yield floor("the same: times bare libsumo", 25, ratio(ekf, bare), "{:.1f}")
    quickest = best(results, "async-")
    parallel = ratio(ekf, quickest[1] if quickest else None)
    yield floor("the same: times the best AsyncVectorEnv on two cores", 10, parallel, "{:.1f}")
    for estimator, bound in (("ukf", 10_000), ("enkf", 5_000), ("mhe", 1_200)):
        rate = rate_of(results, vector_name(estimator, FEW, 1024), "one thread")
        what = f"1,024 episodes, {estimator.upper().replace('EN', 'En')}: steps a second"
        yield floor(what, bound, rate)
    recording = results["libsumo"].share("recording", "bare") if "libsumo" in results else None
    yield floor("recording: share of bare libsumo", 0.85, recording, "{:.0%}")
    pool = "recording-processes"
    two = results[pool].share("several", "one") if pool in results else None
    yield floor("recording in two processes: times one", 1.8, two, "{:.2f}")
    for kept, road in (("memory-paper", "PaperHighway"), ("memory-private", "PrivateHighway")):
        yield from _memory(results, kept, road)
    yield floor(
        "PPO with the EKF, two cores: steps a second", 12_000, rate_of(results, "ppo", "PPO")
    )


def _memory(results: Results, row: str, road: str) -> Iterator[Target]:
    own = growth = records = None
    if row in results:
        result = results[row]
        records = result.note("records")
        late, early = result.note("late"), result.note("early")
        if result.peak is not None and result.libraries is not None:
            own = result.peak - result.libraries
        if late is not None and early is not None:
            growth = late - early
    what = f"1,024 episodes of {road} over {records or 256:.0f} records: MiB beside the libraries"
    yield Target(what, GIB, False, own, "{:,.0f}")
    yield Target(
        f"{road}: MiB that 10,000 episodes add, the first 3,072 left out",
        FLAT,
        False,
        growth,
        "{:.1f}",
    )
