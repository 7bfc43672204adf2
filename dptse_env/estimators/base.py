"""The interface of estimators and their output.

An estimator follows a batch of episodes. A step is `predict` under the boundary inputs, then
`update` by the released values, then `estimate`. Both take the indices of the episodes that they
change.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from dptse_env.estimators.flicker import Flicker
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.road import Road
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.validation import require

Backend = Literal["compiled", "reference"]

Played = Mapping[str, Sequence[float]]
"""Numbers of an environment by name, as cards of weights have ranges of them:

``flows``
    1 where flows are released, 0 where speeds are.
``span``
    Largest number of segments of a query.
``epsilon``
    Privacy loss.
``connected``
    Share of connected vehicles.
``slow_share``, ``slow_speed``
    Share of the vehicles of classes that are slower than the limit, and their largest speeds
    [km/h].
``headway``
    Desired time headways of drivers [s], where they are given.
``own_parameters``
    1 where the ARZ parameters are the road's own, 0 where they are a shipped set.
"""


class Estimate(NamedTuple):
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
        density, speed, density_std, speed_std = self
        return Estimate(
            density.take(episodes, 0),
            speed.take(episodes, 0),
            density_std.take(episodes, 0),
            speed_std.take(episodes, 0),
        )


class Measurement(NamedTuple):
    """Measurement of one second of k episodes, as it was released.

    Its C channels are the M of ``model.channels``, then the R boundary segments where these are
    released; estimators read the first M.

    Attributes:
        observed: Channels that were queried or are always observed, and answered, shape (k, C).
        values: Average density [veh/km] of a channel's segments and their average centred flow
            [veh/h], or their mean speed [km/h]: shape (k, C, 2); ignored where not observed.
        sigma: Standard deviations of their noise, in the same units, shape (k, C, 2).
        centre: Speeds [km/h] that the flows are centred on, of the segments, and of the boundary
            segments where these are released: shape (k, S) or (k, S + R); NaN for mean speeds.
    """

    observed: BoolArray
    values: FloatArray
    sigma: FloatArray
    centre: FloatArray

    @classmethod
    def of(
        cls,
        model: ARZModel,
        observed: BoolArray,
        values: FloatArray,
        sigma: FloatArray,
        centre: FloatArray | None = None,
    ) -> Measurement:
        """Return a measurement of the channels of a model, for callers outside of the process.

        Args:
            model: The road and what is measured of it.
            observed: Shape (k, M).
            values: Shape (k, M, 2).
            sigma: Shape (k, M, 2), or one that broadcasts to it.
            centre: Shape (k, S), or one that broadcasts to it; None for the model's reference
                speed.

        Raises:
            ValueError: A shape is another, or a deviation or centre is negative or not finite.
        """
        seen = np.ascontiguousarray(observed, dtype=np.bool_)
        if seen.ndim != 2 or seen.shape[1] != model.channels.size:
            shape = f"(k, {model.channels.size})"
            raise ValueError(f"observed must have shape {shape}, got {seen.shape}")
        given = np.ascontiguousarray(values, dtype=np.float64)
        if given.shape != (*seen.shape, 2):
            raise ValueError(f"values must have shape {(*seen.shape, 2)}, got {given.shape}")
        deviations = _full("sigma", sigma, given.shape)
        if not (np.isfinite(deviations) & (deviations >= 0.0)).all():
            raise ValueError("sigma must be finite and >= 0")
        places = len(seen), model.n_segments
        if model.centre is None:
            return cls(seen, given, deviations, np.full(places, np.nan))
        around = _full("centre", model.centre if centre is None else centre, places)
        if not np.isfinite(around).all():
            raise ValueError("centre must be finite")
        return cls(seen, given, deviations, around)

    def at(self, episodes: slice | int) -> Measurement:
        """Return the rows of a block of the k episodes, or those of one without the axis."""
        observed, values, sigma, centre = self
        return Measurement(observed[episodes], values[episodes], sigma[episodes], centre[episodes])

    def on_road(self, n_rows: int, n_segments: int) -> Measurement:
        """Return the channels of the road alone, without those of boundary segments."""
        if self.observed.shape[1] == n_rows and self.centre.shape[1] == n_segments:
            return self
        return Measurement(
            np.ascontiguousarray(self.observed[:, :n_rows]),
            np.ascontiguousarray(self.values[:, :n_rows]),
            np.ascontiguousarray(self.sigma[:, :n_rows]),
            np.ascontiguousarray(self.centre[:, :n_segments]),
        )


def _full(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return numbers of full shape; the last axis is not broadcast."""
    given = np.asarray(values, dtype=np.float64)
    if given.ndim > 0 and given.shape[-1] != shape[-1]:
        raise ValueError(f"{name} must have shape {shape} or broadcast to it, got {given.shape}")
    try:
        return np.array(np.broadcast_to(given, shape))
    except ValueError as problem:
        message = f"{name} must have shape {shape} or broadcast to it, got {given.shape}"
        raise ValueError(message) from problem


class Estimator(ABC):
    """Estimator of the traffic state of a batch of episodes, S segments each.

    A subclass has `_reset`, `_predict`, `_update` and `_estimate`. It writes `innovations` and
    `diverged` of the episodes that it updates, and `fallback` too if its update can fail. With
    `_memory` its episodes can go back in time, and `_limits` say what indexes others in it.

    Attributes:
        model: The traffic model.
        n_episodes: Episodes n in the batch.
        settings: Its settings, of its ``settings_type``.
        innovations: `(n, M, 2)` residuals of both releases before the last update, over their
            predicted standard deviations; 0 where nothing was observed.
        diverged: `(n,)` whether the last update found the filter non-finite or indefinite and
            reset it to its prior.
        fallback: `(n,)` whether the last update had no solution and left the estimate at the
            prediction.
    """

    settings_type: ClassVar[type] = EstimatorSettings
    """Dataclass of its settings."""
    is_compiled: ClassVar[bool] = False
    """True where `predict` and `update` release Python's global interpreter lock, so that blocks of
    episodes benefit from threads."""
    has_demand: ClassVar[bool] = True
    """True where its settings may ask for demand states."""
    steps_model: ClassVar[bool] = True
    """True where it steps the model, whose time step then must satisfy the CFL condition."""
    reads_flicker: ClassVar[bool] = False
    """True where its settings may ask for flicker, which `_flickering` then adds."""

    def __init__(self, model: ARZModel, n_episodes: int, settings: Any) -> None:
        """See `make_estimator`."""
        self.model = model
        self.n_episodes = n_episodes
        self.settings = settings
        scale = np.array(getattr(settings, "noise_scale", (1.0, 1.0)))
        self._noise_scale = None if (scale == 1.0).all() else scale
        cap = getattr(settings, "speed_cap", None)
        self._largest_speed = None if cap is None else cap * model.road.limits[: model.n_segments]
        asks = self.reads_flicker and settings.flicker
        self._flicker = Flicker(model, n_episodes) if asks else None
        self.innovations = np.zeros((n_episodes, model.channels.size, 2))
        self.diverged = np.zeros(n_episodes, dtype=np.bool_)
        self.fallback = np.zeros(n_episodes, dtype=np.bool_)

    @staticmethod  # noqa: B027 (most refuse none)
    def check_settings(model: ARZModel, settings: Any) -> None:
        """Refuse settings that it cannot have on a road; it is not made.

        Args:
            model: The model, with the demand states that the settings ask for.
            settings: The settings.

        Raises:
            ValueError: A setting is out of range on this road.
        """

    @classmethod
    def in_force(cls, road: Road, played: Played, settings: Any) -> Any:
        """Return settings with a value for each that is left to what is played.

        Args:
            road: The road.
            played: What is played on it.
            settings: The settings.
        """
        return settings

    @classmethod
    def inherits(cls, road: Road, played: Played, settings: Any) -> Mapping[str, str]:
        """Return the settings that were made for other roads, traffic or releases, and for which.

        Args:
            road: The road.
            played: What is played on it.
            settings: The settings.
        """
        return {}

    def reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        """Reset episodes.

        Args:
            episodes: `(k,)` distinct indices.
            states: `(k, 2 S)` prior means of the traffic; demand factors begin at 1.
            generators: A random stream per episode, for estimators that draw.
        """
        shape = (len(episodes), 2 * self.model.n_segments)
        if states.shape != shape:
            raise ValueError(f"states must have shape {shape}, got {states.shape}")
        if self.model.n_demand_states > 0:
            factors = np.ones((len(episodes), self.model.n_demand_states))
            states = np.concatenate([states, factors], axis=1)
        self.innovations[episodes] = 0.0
        self.diverged[episodes] = False
        self.fallback[episodes] = False
        if self._flicker is not None:
            self._flicker.reset(episodes)
        self._reset(episodes, states, generators)

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Predict episodes `(k,)` one step ahead under the model's inputs `(k, n_u)`."""
        shape = (len(episodes), self.model.n_inputs)
        if inputs.shape != shape:
            raise ValueError(f"inputs must have shape {shape}, got {inputs.shape}")
        self._predict(episodes, inputs)

    def update(self, episodes: IntArray, measured: Measurement) -> None:
        """Update distinct episodes `(k,)` by what was released of them.

        Observed values that are not finite make a filter diverge.
        """
        own = measured.on_road(self.model.channels.size, self.model.n_segments)
        if self._noise_scale is not None:
            observed, values, sigma, centre = own
            own = Measurement(observed, values, self._noise_scale * sigma, centre)
        self._update(episodes, own)

    def estimate(self) -> Estimate:
        """Current estimate of all episodes, its speeds held to the settings' ``speed_cap``."""
        estimate = self._estimate()
        if self._largest_speed is not None:
            np.minimum(estimate.speed, self._largest_speed, out=estimate.speed)
        return estimate

    @classmethod
    def goes_back(cls) -> bool:
        """Return whether its episodes can go back in time: it says what it remembers."""
        return cls._memory is not Estimator._memory

    @property
    def memory(self) -> tuple[AnyArray, ...]:
        """All that an episode's past has left, arrays with an axis over the n episodes in front.

        An episode whose rows are kept, and copied back later or into an estimator that was made
        alike, goes on from there with the same bits.

        Raises:
            ValueError: The estimator does not say what it remembers.
        """
        since = () if self._flicker is None else (self._flicker.since,)
        return (*self._memory, *since, self.innovations, self.diverged, self.fallback)

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        """Arrays that `reset`, `predict` and `update` change and read, without the base class's."""
        raise ValueError(
            f"estimator must have _memory to go back in time, got {name_of_class(type(self))}"
        )

    @property
    def _limits(self) -> tuple[tuple[AnyArray, float, float], ...]:
        """Arrays of `_memory` that index others, or may be NaN, with their least and largest."""
        return ()

    def check_memory(self) -> None:
        """Refuse numbers in `memory` that no past leaves; kernels index by some, unchecked.

        Raises:
            ValueError: A number is not finite, an index is out of range, or a flag is neither 0
                nor 1.
        """
        limits = {id(array): (low, high) for array, low, high in self._limits}
        for i, array in enumerate(self.memory):
            numbers = array.view(np.uint8) if array.dtype == np.bool_ else array
            if array.dtype == np.bool_:
                allowed, wrong = "0 or 1", numbers > 1
            elif id(array) in limits:
                low, high = limits[id(array)]
                allowed, wrong = f"in {low:g}..{high:g}", (numbers < low) | (numbers > high)
            else:
                allowed, wrong = "finite", ~np.isfinite(numbers)
            first = next(iter(numbers[wrong].tolist()), None)
            require(first is None, f"memory[{i}]", allowed, first)

    @abstractmethod
    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None: ...

    @abstractmethod
    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None: ...

    @abstractmethod
    def _update(self, episodes: IntArray, measured: Measurement) -> None: ...

    def _flickering(self, episodes: IntArray, measured: Measurement) -> Measurement:
        """Return what was measured with the deviations of flicker, where settings ask for it."""
        if self._flicker is None:
            return measured
        means, (observed, _, sigma, centre) = self._means_of(episodes), measured
        sigma = self._flicker.deviations(episodes, means, observed, centre, sigma)
        return measured._replace(sigma=sigma)

    def _means_of(self, episodes: IntArray) -> FloatArray:
        """Return means `(k, n_x)` [veh/km, veh/h], of an estimator that reads flicker."""
        raise NotImplementedError

    @abstractmethod
    def _estimate(self) -> Estimate:
        """Return the estimate of all episodes in fresh arrays."""

    def check_estimate(self, estimate: Estimate) -> None:
        """Refuse an estimate that is not finite or not of shape (n, S).

        Estimators of this package are reset when they diverge; those of other packages may not be.

        Raises:
            ValueError: It is not.
        """
        shape = self.n_episodes, self.model.n_segments
        for name in Estimate._fields:
            values = np.asarray(getattr(estimate, name, None))
            got = f"{values.dtype} of shape {values.shape}"
            if values.shape == shape and values.dtype.kind == "f":
                if np.isfinite(values).all():
                    continue
                episode, segment = np.argwhere(~np.isfinite(values))[0].tolist()
                got = f"{values[episode, segment]} in episode {episode}, segment {segment}"
            raise ValueError(
                f"estimator {name_of_class(self)}.estimate() must return finite floats {name!r} of "
                f"shape {shape}, got {got}"
            )


class KernelEstimator(Estimator):
    """Estimator of two kernels, on arrays that they change in place.

    Attributes:
        arrays: All that the kernels read and write.
    """

    is_compiled: ClassVar[bool] = True
    predict_kernel: ClassVar[Callable[..., None]]
    """Kernel of the arrays, episodes and inputs; see `Estimator.predict`."""
    update_kernel: ClassVar[Callable[..., None]]
    """Kernel of the arrays, episodes and a `Measurement`; see `Estimator.update`."""
    arrays: Bundle

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        self.predict_kernel(self.arrays, episodes, inputs)

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        self.update_kernel(self.arrays, episodes, self._flickering(episodes, measured))


class SegmentEstimator(KernelEstimator):
    """Estimator of densities and speeds by two kernels that do not step the traffic model.

    Attributes:
        present: Densities [veh/km], speeds [km/h] and deviations of both, shape (n, S, 4).
        priors: Those that episodes begin with, likewise.
    """

    has_demand: ClassVar[bool] = False
    steps_model: ClassVar[bool] = False
    restart_kernel: ClassVar[Callable[..., None]]
    """Kernel of the arrays and episodes, which begins these with their priors."""

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self.priors = np.zeros((n_episodes, model.n_segments, 4))
        scale = np.array([model.density_scale, model.speed_scale])
        self.priors[..., 2:] = np.sqrt(settings.initial_variance) * scale
        self.present = self.priors.copy()

    @property
    def means(self) -> FloatArray:
        """Densities [veh/km] and speeds [km/h], shape (n, S, 2)."""
        return self.present[..., :2]

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        density, speed = estimated_traffic(self.model, states)
        self.priors[episodes, :, 0], self.priors[episodes, :, 1] = density, speed
        self.restart_kernel(self.arrays, episodes)

    def _estimate(self) -> Estimate:
        return Estimate(*(self.present[..., j].copy() for j in range(4)))


def estimated_traffic(model: ARZModel, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return density [veh/km] and speed [km/h] of states, the speed at most 1.1 v_f.

    In the cone it never exceeds that; in the paper's box w = psi / rho has no bound.
    """
    return model.density(states), np.minimum(model.speed(states), model.largest_speed)
