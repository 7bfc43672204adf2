"""Base class of estimators: batch size, flags, and checks of arguments."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class EpisodeMeasurements(NamedTuple):
    """Measurements of one episode."""

    observed: BoolArray  # (M,)
    values: FloatArray  # (M, 2)
    sigma: FloatArray  # (M, 2)
    centre: FloatArray  # (S,)


class Measurements(NamedTuple):
    """Checked arguments of `Estimator.update`, all of full shape."""

    episodes: IntArray  # (k,)
    observed: BoolArray  # (k, M)
    values: FloatArray  # (k, M, 2)
    sigma: FloatArray  # (k, M, 2)
    centre: FloatArray  # (k, S), NaN where speeds are released

    def by_episode(self) -> Iterator[tuple[int, EpisodeMeasurements]]:
        """Iterate over the k episodes and their measurements."""
        rows = self.observed, self.values, self.sigma, self.centre
        for episode, *arrays in zip(self.episodes.tolist(), *rows, strict=True):
            yield episode, EpisodeMeasurements(*arrays)


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


def without_repeats(array: FloatArray) -> FloatArray:
    """Return the part of a broadcast array that its other items repeat."""
    return array[tuple(slice(1) if stride == 0 else slice(None) for stride in array.strides)]


def checked_deviations(sigma: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return standard deviations of full shape; refuse one that is negative or not finite."""
    given = np.asarray(sigma, dtype=np.float64)
    if given.shape[-1:] != shape[-1:] or given.ndim > len(shape):
        raise ValueError(f"sigma must have shape {shape} or broadcast to it, got {given.shape}")
    distinct = without_repeats(given)
    sound = (distinct >= 0.0) & np.isfinite(distinct)
    if not sound.all():
        raise ValueError(f"sigma must be finite and >= 0, got {distinct[~sound].flat[0]}")
    try:
        return np.ascontiguousarray(np.broadcast_to(given, shape))
    except ValueError as problem:
        message = f"sigma must have shape {shape} or broadcast to it, got {given.shape}"
        raise ValueError(message) from problem


def checked_measurements(
    n_episodes: int,
    model: ARZModel,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray | None,
) -> Measurements:
    """Return the arguments of `Estimator.update` as contiguous arrays; refuse malformed ones."""
    indices = checked_episodes(episodes, n_episodes)
    shape = indices.size, model.rows.n_rows
    mask = np.ascontiguousarray(observed, dtype=np.bool_)
    if mask.shape != shape:
        raise ValueError(f"observed must have shape {shape}, got {mask.shape}")
    return Measurements(
        indices,
        mask,
        checked_rows("values", values, (*shape, 2)),
        checked_deviations(sigma, (*shape, 2)),
        checked_centres(centre, model, indices.size),
    )


def checked_centres(centre: FloatArray | None, model: ARZModel, n_rows: int) -> FloatArray:
    """Return the centres of flows (n_rows, S): NaN where the model measures speeds."""
    shape = n_rows, model.n_segments
    if model.reference_speed is None:
        return np.full(shape, np.nan)
    if centre is None:
        return np.full(shape, model.reference_speed)
    given = np.asarray(centre, dtype=np.float64)
    if given.ndim > 2 or given.shape[-1:] != shape[1:] or given.shape[:-1] not in ((), shape[:1]):
        raise ValueError(f"centre must have shape {shape} or broadcast to it, got {given.shape}")
    distinct = without_repeats(given)
    if not np.isfinite(distinct).all():
        raise ValueError(f"centre must be finite, got {distinct[~np.isfinite(distinct)].flat[0]}")
    return np.ascontiguousarray(np.broadcast_to(given, shape))


class BatchEstimator(ABC):
    """An estimator of a batch of episodes; subclasses get checked, contiguous arguments.

    Public methods are documented in `Estimator`. A subclass writes `innovations` and `diverged` of
    the episodes that it updates, and `fallback` where its update can fail. It has `_estimate`, or
    `estimate` where its settings have no `speed_cap`.
    """

    is_compiled: ClassVar[bool] = False

    def __init__(self, model: ARZModel, n_episodes: int, settings: Any) -> None:
        """See `make_estimator`."""
        self.model = model
        self.n_episodes = n_episodes
        self.settings = settings
        self._noise_scale = np.array(getattr(settings, "noise_scale", (1.0, 1.0)))
        cap = getattr(settings, "speed_cap", None)
        self._largest_speed = None if cap is None else cap * np.array(model.network.speed_limits)
        self.innovations = np.zeros((n_episodes, model.rows.n_rows, 2))
        self.diverged = np.zeros(n_episodes, dtype=np.bool_)
        self.fallback = np.zeros(n_episodes, dtype=np.bool_)

    def reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        """See `Estimator.reset`."""
        indices = checked_episodes(episodes, self.n_episodes)
        shape = (indices.size, 2 * self.model.n_segments)
        states = checked_rows("states", states, shape)
        if self.model.n_demand_states > 0:
            factors = np.ones((indices.size, self.model.n_demand_states))
            states = np.concatenate([states, factors], axis=1)
        self.innovations[indices] = 0.0
        self.diverged[indices] = False
        self.fallback[indices] = False
        self._reset(indices, states, generators)

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """See `Estimator.predict`."""
        indices = checked_episodes(episodes, self.n_episodes)
        self._predict(indices, checked_rows("inputs", inputs, (indices.size, self.model.n_inputs)))

    def update(
        self,
        episodes: IntArray,
        observed: BoolArray,
        values: FloatArray,
        sigma: FloatArray,
        centre: FloatArray | None = None,
    ) -> None:
        """See `Estimator.update`; observed values that are not finite make a filter diverge."""
        measured = checked_measurements(
            self.n_episodes, self.model, episodes, observed, values, sigma, centre
        )
        self.fallback[measured.episodes] = False
        self._update(measured._replace(sigma=self._noise_scale * measured.sigma))

    def estimate(self) -> Estimate:
        """Current estimate of all episodes, its speeds held to the settings' ``speed_cap``."""
        estimate = self._estimate()
        if self._largest_speed is not None:
            np.minimum(estimate.speed, self._largest_speed, out=estimate.speed)
        return estimate

    def _estimate(self) -> Estimate:
        """Return the estimate of all episodes in fresh arrays."""
        raise NotImplementedError(f"{type(self).__name__} must have a method '_estimate'")

    @abstractmethod
    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None: ...

    @abstractmethod
    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None: ...

    @abstractmethod
    def _update(self, measured: Measurements) -> None: ...
