"""The observation: what the operator knows, as one flat float32 vector.

It is made of named blocks, each with fixed bounds and scaled by physical constants of the
corridor, so there are no running statistics that could be lost between training and use. It holds
released values, the estimator's output, the query history and public settings. It never holds the
truth, a clock, or anything that tells an empty segment from an occupied one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dptse_env.arrays import BoolArray, FloatArray, IntArray, Observation
from dptse_env.estimators import Estimate

AGE_CAP = 60
"""Age [s] beyond which a segment counts as not seen for long."""


@dataclass(frozen=True)
class Knowledge:
    """The operator's knowledge about k episodes, in physical units.

    Attributes:
        estimate: Densities [veh/km], speeds [km/h] and their standard deviations, each (k, S).
        released: Last released (density [veh/km], speed [km/h] or flow [veh/h]) per segment,
            shape (k, S, 2); zero before the first release.
        innovations: Normalised innovations of the last update, shape (k, S, 2); zero where
            nothing was observed.
        age: Steps since each mainline segment was last observed, shape (k, n_mainline).
        queried: The last query, shape (k, n_mainline).
        picked: Segments picked so far for the next query, shape (k, n_mainline).
    """

    estimate: Estimate
    released: FloatArray
    innovations: FloatArray
    age: IntArray
    queried: BoolArray
    picked: BoolArray


@dataclass(frozen=True)
class _Block:
    name: str
    size: int
    low: float
    high: float


class ObservationEncoding:
    """Lays knowledge out in a vector; holds the space and the place of every block.

    Blocks, in order, with S segments (mainline, on-ramps, off-ramps), n mainline segments and F
    fixed sensors:

    ========================= ==== ============================================ =========
    block                     size value                                        bounds
    ========================= ==== ============================================ =========
    density                   S    estimated density / density scale            [0, 4]
    speed                     S    estimated speed / speed scale                [0, 4]
    density_log_std           S    log of (standard deviation / scale)          [-10, 5]
    speed_log_std             S    the same for speed                           [-10, 5]
    released_density          n    last released density / scale                [-5, 5]
    released_speed            n    last released speed / scale, or, under its   [-5, 5]
                                   name, ``released_flow``
    density_innovation        n    normalised innovation, 0 if not observed     [-10, 10]
    speed_innovation          n    the same for speed                           [-10, 10]
    age                       n    steps since last observed / 60, at most 1    [0, 1]
    queried                   n    the last query                               {0, 1}
    fixed_density_innovation  F    normalised innovation of the fixed sensors   [-10, 10]
    fixed_speed_innovation    F    the same for speed                           [-10, 10]
    bandwidth                 1    queries a step / n                           [0, 1]
    epsilon                   1    log10 of the privacy parameter               [-6, 6]
    picked                    n    picks so far (sequential actions only)       {0, 1}
    ========================= ==== ============================================ =========

    Values beyond the bounds are clipped.

    Attributes:
        space: The Gymnasium space, a float32 ``Box``.
        slices: The place of each block, by name.
    """

    def __init__(
        self,
        n_mainline: int,
        n_segments: int,
        fixed_sensors: tuple[int, ...],
        *,
        density_scale: float,
        speed_scale: float,
        bandwidth: int,
        epsilon: float,
        with_picked: bool,
        releases_flow: bool = False,
    ) -> None:
        """Lay out the blocks for a road.

        Args:
            n_mainline: Number of mainline segments n.
            n_segments: Number of segments S, ramps included.
            fixed_sensors: Indices of the segments with a fixed sensor.
            density_scale: Density that counts as one [veh/km].
            speed_scale: Speed that counts as one [km/h].
            bandwidth: Queries a step.
            epsilon: Privacy parameter epsilon.
            with_picked: Whether to show the picks of an unfinished decision.
            releases_flow: Whether the mechanism releases centred flows in place of mean speeds.
        """
        self.n_mainline = n_mainline
        self.fixed_sensors = np.array(fixed_sensors, dtype=np.int64)
        self._scales = density_scale, speed_scale
        self._second = "released_flow" if releases_flow else "released_speed"
        self._second_scale = density_scale * speed_scale if releases_flow else speed_scale
        self._bandwidth_share = bandwidth / n_mainline
        self._log_epsilon = float(np.log10(epsilon))
        n, s, f = n_mainline, n_segments, len(fixed_sensors)
        blocks = [
            _Block("density", s, 0, 4),
            _Block("speed", s, 0, 4),
            _Block("density_log_std", s, -10, 5),
            _Block("speed_log_std", s, -10, 5),
            _Block("released_density", n, -5, 5),
            _Block(self._second, n, -5, 5),
            _Block("density_innovation", n, -10, 10),
            _Block("speed_innovation", n, -10, 10),
            _Block("age", n, 0, 1),
            _Block("queried", n, 0, 1),
            _Block("fixed_density_innovation", f, -10, 10),
            _Block("fixed_speed_innovation", f, -10, 10),
            _Block("bandwidth", 1, 0, 1),
            _Block("epsilon", 1, -6, 6),
        ]
        if with_picked:
            blocks.append(_Block("picked", n, 0, 1))
        sizes = [block.size for block in blocks]
        ends = np.cumsum(sizes).tolist()
        self.slices = {
            block.name: slice(end - block.size, end)
            for block, end in zip(blocks, ends, strict=True)
        }
        low = np.repeat([block.low for block in blocks], sizes).astype(np.float32)
        high = np.repeat([block.high for block in blocks], sizes).astype(np.float32)
        self.space = spaces.Box(low, high, dtype=np.float32)

    def encode(self, knowledge: Knowledge) -> Observation:
        """Return the observations of k episodes, shape (k, size), always inside the space."""
        n = self.n_mainline
        density_scale, speed_scale = self._scales
        estimate, released, innovations = (
            knowledge.estimate,
            knowledge.released,
            knowledge.innovations,
        )
        flat = np.empty((len(released), self.space.shape[0]), dtype=np.float32)
        values: dict[str, NDArray[Any] | float] = {
            "density": estimate.density / density_scale,
            "speed": estimate.speed / speed_scale,
            "density_log_std": _log(estimate.density_std / density_scale),
            "speed_log_std": _log(estimate.speed_std / speed_scale),
            "released_density": released[:, :n, 0] / density_scale,
            self._second: released[:, :n, 1] / self._second_scale,
            "density_innovation": innovations[:, :n, 0],
            "speed_innovation": innovations[:, :n, 1],
            "age": knowledge.age / AGE_CAP,
            "queried": knowledge.queried,
            "fixed_density_innovation": innovations[:, self.fixed_sensors, 0],
            "fixed_speed_innovation": innovations[:, self.fixed_sensors, 1],
            "bandwidth": self._bandwidth_share,
            "epsilon": self._log_epsilon,
            "picked": knowledge.picked,
        }
        for name, place in self.slices.items():
            flat[:, place] = values[name]
        np.maximum(flat, self.space.low, out=flat)
        return np.minimum(flat, self.space.high, out=flat)

    def block(self, observation: Observation, name: str) -> Observation:
        """Return the block ``name`` of observations of shape (..., size).

        Raises:
            ValueError: There is no such block.
        """
        if name not in self.slices:
            raise ValueError(f"unknown observation block {name!r}; known: {', '.join(self.slices)}")
        return observation[..., self.slices[name]]


def _log(deviation: FloatArray) -> FloatArray:
    # A zero has no logarithm; the smallest number ends at the lower bound just as well.
    return np.log(np.maximum(deviation, np.finfo(np.float64).tiny))
