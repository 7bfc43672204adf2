"""What every estimator is: the protocol, its settings and its output.

An estimator follows a batch of episodes. A step is `predict` under the boundary inputs, then
`update` by what was released, then `estimate`. Both take the indices of the episodes they
concern; the others stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, get_args

import numpy as np

from dptse_env.model import Bounds
from dptse_env.model.network import BoolArray, FloatArray, IntArray
from dptse_env.validation import non_negative, positive, sequence

Backend = Literal["compiled", "reference"]


@dataclass(frozen=True)
class Estimate:
    """Estimates and their standard deviations, `(n, S)` each, in fresh arrays.

    Attributes:
        density: [veh/km].
        speed: [km/h].
        density_std: [veh/km].
        speed_std: [km/h].
    """

    density: FloatArray
    speed: FloatArray
    density_std: FloatArray
    speed_std: FloatArray

    def at(self, episodes: IntArray) -> Estimate:
        """Return a copy of the rows of `episodes` `(k,)`, `(k, S)` each."""
        return Estimate(
            self.density[episodes],
            self.speed[episodes],
            self.density_std[episodes],
            self.speed_std[episodes],
        )


class Estimator(Protocol):
    """Estimates the traffic state of a batch of episodes, S segments each.

    Attributes:
        n_episodes: Episodes n in the batch.
        innovations: `(n, S, 2)` residuals of density and speed before the last update, over their
            predicted standard deviations; 0 where nothing was observed.
        diverged: `(n,)` whether the last update found the filter non-finite or indefinite and
            put it back to its prior.
    """

    n_episodes: int
    innovations: FloatArray
    diverged: BoolArray

    def reset(
        self,
        episodes: IntArray,
        states: FloatArray,
        generators: Sequence[np.random.Generator],
    ) -> None:
        """Start episodes over.

        Args:
            episodes: `(k,)` distinct indices.
            states: `(k, 2 S)` prior means.
            generators: One random stream an episode, for estimators that draw.
        """

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Move episodes `(k,)` one step ahead under the model's inputs `(k, n_u)`."""

    def update(
        self, episodes: IntArray, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        """Take in measurements.

        Args:
            episodes: `(k,)` distinct indices.
            observed: `(k, S)` which segments were measured.
            values: `(k, S, 2)` density [veh/km] and speed [km/h]; ignored where not observed.
            sigma: `(2,)` standard deviations of their noise [veh/km, km/h].
        """

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""


@dataclass(frozen=True)
class EstimatorSettings:
    """Tuning of the estimators, in units of the jam density rho_m and of v_f.

    Attributes:
        process_noise: Standard deviations of what the model misses in one step: of rho over
            rho_m, of psi over rho_m v_f.
        walk_noise: The same of the random walk: of rho over rho_m, of v over v_f.
        initial_variance: Variance of each normalised component of the prior.
        bounds: Where means are held: the `cone` of physical states or the paper's `box`.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    process_noise: tuple[float, float] = (0.01, 0.01)
    walk_noise: tuple[float, float] = (0.025, 0.025)
    initial_variance: float = 1e-3
    bounds: Bounds = "cone"

    def __post_init__(self) -> None:
        """Check values; lists, as JSON has them, become tuples."""
        for field in ("process_noise", "walk_noise"):
            path = f"estimator.{field}"
            pair = sequence(path, getattr(self, field), length=2)
            noise = tuple(non_negative(f"{path}[{i}]", value) for i, value in enumerate(pair))
            object.__setattr__(self, field, noise)
        variance = positive("estimator.initial_variance", self.initial_variance)
        object.__setattr__(self, "initial_variance", variance)
        if self.bounds not in get_args(Bounds):
            raise ValueError(f"estimator.bounds must be 'cone' or 'box', got {self.bounds!r}")


class Measurements(NamedTuple):
    """Checked arguments of `Estimator.update`."""

    episodes: IntArray
    observed: BoolArray
    values: FloatArray
    sigma: FloatArray


def checked_episodes(episodes: IntArray, n_episodes: int) -> IntArray:
    """Indices as contiguous int64, refused where there is no such episode."""
    indices = np.ascontiguousarray(episodes, dtype=np.int64)
    if indices.ndim != 1:
        raise ValueError(f"episodes must be a vector of indices, got shape {indices.shape}")
    # A list of Python ints compares faster than numpy reduces, as long as it is short.
    for index in indices.tolist():
        if not 0 <= index < n_episodes:
            raise ValueError(f"episodes must be in 0..{n_episodes - 1}, got {index}")
    return indices


def checked_rows(name: str, rows: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """An array as contiguous float64, refused if its shape is not the one expected."""
    array = np.ascontiguousarray(rows, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    return array


def checked_measurements(
    n_episodes: int,
    n_segments: int,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
) -> Measurements:
    """Check what `Estimator.update` is given.

    Raises:
        ValueError: naming the argument, what is wrong with it and what is allowed.
    """
    indices = checked_episodes(episodes, n_episodes)
    mask = np.ascontiguousarray(observed, dtype=np.bool_)
    if mask.shape != (indices.size, n_segments):
        raise ValueError(f"observed must have shape {(indices.size, n_segments)}, got {mask.shape}")
    noise = checked_rows("sigma", sigma, (2,))
    for i, value in enumerate(noise.tolist()):
        if not 0.0 <= value < math.inf:
            raise ValueError(f"sigma[{i}] must be finite and >= 0, got {value}")
    return Measurements(
        indices, mask, checked_rows("values", values, (indices.size, n_segments, 2)), noise
    )
