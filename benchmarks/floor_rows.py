"""The arithmetic floors as rows of the table."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks import floors
from benchmarks.peers import Plain, ekf_states, programs_of
from benchmarks.replay import Replay
from benchmarks.timing import Row
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.estimators.compiled.normals import bits_for, stream_of
from dptse_env.model.road_arrays import road_of
from dptse_env.utils.arrays import FloatArray, IntArray

REPEATS = 25  # steps in one call, which hides the call


class Floor(Row):
    """Some steps' arithmetic at the beginning of each block, always the same."""

    def __init__(self, estimator: str, run: Callable[[int], float]) -> None:
        """Take what runs a number of steps."""
        super().__init__(estimator, "arithmetic floor")
        self._run = run

    def begin(self) -> None:
        """Nothing to go back to."""

    def run(self, steps: range) -> Iterator[tuple[int, float]]:
        """Time some repetitions together."""
        start = time.perf_counter()
        result = self._run(REPEATS)
        seconds = (time.perf_counter() - start) / REPEATS
        if not np.isfinite(result):
            raise RuntimeError(f"the floor of {self.estimator} is not finite")
        yield steps.start, seconds


class Scene(NamedTuple):
    """A step in the middle of a replay, as the floors take it.

    Attributes:
        road: The `Road` as a plain tuple.
        state: `(2 S,)` [veh/km, veh/h].
        inputs: `(n_u,)`.
        covariance: `(2 S, padded)` of an EKF, normalised.
        scale: `(2 S,)` units of a normalised state.
        segments: `(m,)` measured.
        rows: `(2 m, 3)` an output's derivatives by its segment's rho and psi, its variance.
        joint: `(2 m, padded)` [S, C] of that EKF.
        n_members: Members of an ensemble.
    """

    road: tuple[Any, ...]
    state: FloatArray
    inputs: FloatArray
    covariance: FloatArray
    scale: FloatArray
    segments: IntArray
    rows: FloatArray
    joint: FloatArray
    n_members: int


def scene_of(replay: Replay, block: int) -> Scene:
    """Take the scene at the block in the middle."""
    plain = Plain(replay)
    states = ekf_states(replay, block, plain.scale)
    k = sorted(states)[len(states) // 2]
    mean, P = states[k]
    plain.observed = replay.observed[k, 0]
    segments, n, outputs = np.flatnonzero(plain.observed), mean.size, replay.n_outputs
    H = plain.outputs_by_state(mean)
    rows = np.empty((outputs, 3))
    rows[:, 2] = np.tile(np.square(replay.sigma / plain.measured_scale), segments.size)
    for i, s in enumerate(segments):
        rows[2 * i : 2 * i + 2, :2] = H[2 * i : 2 * i + 2, 2 * s : 2 * s + 2]
    covariance = np.zeros((n, padded(n)))
    covariance[:, :n] = P
    joint = np.zeros((outputs, padded(outputs + n + 1)))
    joint[:, :outputs] = H @ P @ H.T + np.diag(rows[:, 2])
    joint[:, outputs : outputs + n] = H @ P
    return Scene(
        tuple(road_of(replay.model)), mean * plain.scale, replay.inputs[k, 0], covariance,
        plain.scale, segments, rows, joint, replay.settings.enkf.n_members,
    )  # fmt: skip


def floor_of(estimator: str, replay: Replay, block: int) -> Floor:
    """The floor of an estimator; that of the MHE is the replay's last program kept."""
    if estimator == "mhe":
        programs = programs_of(replay, block)
        P, q, _, _ = programs[max(programs)]
        return Floor("mhe", partial(floors.mhe, band=floors.banded(0.5 * P.toarray()), right=-q))
    scene = scene_of(replay, block)
    return Floor(estimator, {"ekf": _ekf, "ukf": _ukf, "enkf": _enkf}[estimator](scene))


def _ekf(scene: Scene) -> Callable[[int], float]:
    road, state, inputs, covariance, _, segments, rows, _, _ = scene
    return lambda repeats: floors.ekf(repeats, road, state, inputs, covariance, segments, rows)


def _ukf(scene: Scene) -> Callable[[int], float]:
    road, state, inputs, covariance, scale, segments, _, joint, _ = scene
    n = state.size
    spread = np.zeros_like(covariance)  # a narrow one, whose points are all physical
    spread[:, :n] = 1e-4 * covariance[:, :n] * scale * scale[:, None]
    points = np.empty((n, padded(2 * n + 1)))
    return lambda repeats: floors.ukf(repeats, road, state, inputs, spread, segments, points, joint)


def _enkf(scene: Scene) -> Callable[[int], float]:
    road, state, inputs, _, _, segments, _, joint, count = scene
    rng = np.random.default_rng(0)
    members = np.repeat(state[:, None], padded(count), axis=1)
    members *= 1.0 + 0.01 * rng.normal(size=members.shape)
    draws = np.empty((state.size + len(joint)) * count, dtype=np.float32)
    stream, bits = stream_of(rng), bits_for(draws.size)
    return lambda repeats: floors.enkf(
        repeats, road, members, inputs, segments, joint, stream, draws, bits
    )
