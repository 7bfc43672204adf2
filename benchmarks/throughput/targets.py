"""Targets for the environment, and their verdicts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from benchmarks.throughput.results import Results, best, find
from benchmarks.throughput.rows import FEW, vector_name

GIB = 1024.0
FLAT = 16.0  # [MiB] that ten thousand episodes may add


class Target(NamedTuple):
    """A figure and the bound that it is compared with.

    Attributes:
        description: The figure in words.
        bound: The bound.
        measured: The figure; NaN where a row that it needs was not measured.
        form: Format of both.
        is_floor: Whether the figure must be at least the bound; else it must be below it.
    """

    description: str
    bound: float
    measured: float
    form: str = "{:,.0f}"
    is_floor: bool = True

    @property
    def verdict(self) -> str:
        """``met``, ``missed`` or ``not measured``."""
        if math.isnan(self.measured):
            return "not measured"
        met = self.measured >= self.bound if self.is_floor else self.measured < self.bound
        return "met" if met else "missed"


def targets(results: Results) -> Iterator[Target]:
    """Yield each target with its figure, all from one run."""
    ekf, libsumo = find(results, vector_name("ekf", FEW, 1024)), find(results, "libsumo")
    rate, share = ekf.rate("one thread"), ekf.share("one thread", "kernel")
    parallel = find(results, best(results, "async-") or "").rate("environment")
    yield Target("1,024 episodes, EKF, one core: share of the bare estimator", 0.6, share, "{:.0%}")
    yield Target("the same: steps a second", 25_000, rate)
    yield Target("the same: times bare libsumo", 25, rate / libsumo.rate("bare"), "{:.1f}")
    description = "the same: times the best AsyncVectorEnv on two cores"
    yield Target(description, 10, rate / parallel, "{:.1f}")
    for name, label, bound in (
        ("ukf", "UKF", 10_000),
        ("enkf", "EnKF", 5_000),
        ("mhe", "MHE", 1_200),
    ):
        rate = find(results, vector_name(name, FEW, 1024)).rate("one thread")
        yield Target(f"1,024 episodes, {label}: steps a second", bound, rate)
    recording = libsumo.share("recording", "bare")
    yield Target("recording: share of bare libsumo", 0.85, recording, "{:.0%}")
    pooled = find(results, "recording-processes").share("several", "one")
    yield Target("recording in two processes: times one", 1.8, pooled, "{:.2f}")
    for name, road in (("memory-paper", "PaperHighway"), ("memory-private", "PrivateHighway")):
        result = find(results, name)
        records = "256" if math.isnan(result.note("records")) else f"{result.note('records'):.0f}"
        description = f"1,024 episodes of {road} over {records} records: MiB beside the libraries"
        yield Target(description, GIB, result.peak - result.libraries, is_floor=False)
        description = f"{road}: MiB that 10,000 episodes add, the first 3,072 left out"
        growth = result.note("late") - result.note("early")
        yield Target(description, FLAT, growth, "{:.1f}", is_floor=False)
    rate = find(results, "ppo").rate("PPO")
    yield Target("PPO with the EKF, two cores: steps a second", 12_000, rate)
