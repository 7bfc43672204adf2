"""Base class of estimators: batch size, flags, and checks of arguments."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class Measurements(NamedTuple):
    """Checked arguments of `Estimator.update`."""

    episodes: IntArray
    observed: BoolArray
    values: FloatArray
    sigma: FloatArray


def checked_episodes(episodes: IntArray, n_episodes: int) -> IntArray:
    """Return indices as contiguous int64; indices of no episode are refused."""
    indices = np.ascontiguousarray(episodes, dtype=np.int64)
    if indices.ndim != 1:
        raise ValueError(f"episodes must be a vector of indices, got shape {indices.shape}")
    # For short arrays, comparing Python ints is faster than a reduction in numpy.
    for index in indices.tolist():
        if not 0 <= index < n_episodes:
            raise ValueError(f"episodes must be in 0..{n_episodes - 1}, got {index}")
    return indices


def checked_rows(name: str, rows: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return an array as contiguous float64; another shape than the expected one is refused."""
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
    """Return the arguments of `Estimator.update` as contiguous arrays; refuse malformed ones."""
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


class BatchEstimator(ABC):
    """An estimator of a batch of episodes; subclasses get checked, contiguous arguments.

    Public methods are documented in `Estimator`. A subclass writes `innovations` and `diverged` of
    the episodes that it updates, and `fallback` where its update can fail.
    """

    is_compiled: ClassVar[bool] = False

    def __init__(self, model: ARZModel, n_episodes: int, settings: Any) -> None:
        """See `make_estimator`."""
        self.model = model
        self.n_episodes = n_episodes
        self.settings = settings
        self._noise_scale: float = getattr(settings, "noise_scale", 1.0)
        self.innovations = np.zeros((n_episodes, model.n_segments, 2))
        self.diverged = np.zeros(n_episodes, dtype=np.bool_)
        self.fallback = np.zeros(n_episodes, dtype=np.bool_)

    def reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        """See `Estimator.reset`."""
        indices = checked_episodes(episodes, self.n_episodes)
        states = checked_rows("states", states, (indices.size, self.model.n_states))
        self.innovations[indices] = 0.0
        self.diverged[indices] = False
        self.fallback[indices] = False
        self._reset(indices, states, generators)

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """See `Estimator.predict`."""
        indices = checked_episodes(episodes, self.n_episodes)
        self._predict(indices, checked_rows("inputs", inputs, (indices.size, self.model.n_inputs)))

    def update(
        self, episodes: IntArray, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        """See `Estimator.update`; observed values that are not finite make a filter diverge."""
        sizes = self.n_episodes, self.model.n_segments
        measured = checked_measurements(*sizes, episodes, observed, values, sigma)
        self.fallback[measured.episodes] = False
        self._update(measured._replace(sigma=self._noise_scale * measured.sigma))

    @abstractmethod
    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""

    @abstractmethod
    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None: ...

    @abstractmethod
    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None: ...

    @abstractmethod
    def _update(self, measured: Measurements) -> None: ...
