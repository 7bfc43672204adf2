"""The extended Kalman filter, the default estimator, and what all filters with a covariance share.

Means are in physical units, as the model takes them; covariances are normalised, rho by rho_m and
psi by rho_m v_f, so that variances of all components are of one order. Episodes are treated one by
one inside compiled code.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators.base import Estimate, KernelEstimator, Measurement
from dptse_env.estimators.linalg import is_covariance, mirror, padded, pair_update, propagate
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.arrays import ARZ, Channels
from dptse_env.model.parameters import LARGEST_W, VACUUM
from dptse_env.model.step import (
    advance,
    clip,
    floored_speed,
    make_scratch,
    normalise,
    pressure,
    project,
    write_channel,
)
from dptse_env.road import Road
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import (
    Bundle,
    all_finite,
    any_of,
    copy_vector,
    fill_vector,
    inline_part,
    kernel,
    kernel_part,
)


class Filters(NamedTuple):
    """State of the filters of n episodes."""

    means: FloatArray  # (n, n_x) [veh/km, veh/h], then demand factors if there are any
    covariances: FloatArray  # (n, n_x, padded) normalised, in their lower halves; padding is zero
    priors: FloatArray  # (n, n_x) prior means
    innovations: FloatArray  # (n, M, 2)
    diverged: BoolArray  # (n,)
    units: FloatArray  # (n_x,) of normalised components [veh/km, veh/h, 1]
    initial_variance: FloatArray  # (n_x,) normalised
    process_variance: FloatArray  # (n_x,) normalised, of a step
    # (2,) variances at rho_m of vehicles with the others' w, and of psi beside that
    vehicle_variance: FloatArray
    is_box: bool  # whether means are projected into the paper's box, not the cone


class CovarianceFilter(KernelEstimator):
    """Means and covariances of all episodes as arrays for kernels.

    Attributes:
        filters: These arrays, which predictions and updates change in place.
    """

    reads_flicker = True

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        n_states = model.n_states
        start = model.project(np.zeros((n_episodes, n_states)), settings.bounds)
        self.filters = Filters(
            means=start,
            covariances=np.zeros((n_episodes, n_states, padded(n_states))),
            priors=start.copy(),
            innovations=self.innovations,
            diverged=self.diverged,
            units=model.state_scale,
            initial_variance=initial_variance(model, settings),
            process_variance=process_variance(model, settings),
            vehicle_variance=np.square(settings.vehicle_noise),
            is_box=settings.bounds == "box",
        )
        self.arrays = self._moments = Bundle(*model.dynamics, self.filters)
        for episode in range(n_episodes):
            restart(self.filters, episode)

    @property
    def states(self) -> FloatArray:
        """Means `(n, n_x)` [veh/km, veh/h], then demand factors if there are any; a copy."""
        return self.filters.means.copy()

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f, a copy."""
        lower = np.tril(self.filters.covariances[:, :, : self.model.n_states])
        return np.asarray(lower + np.tril(lower, -1).swapaxes(1, 2))

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return self.filters.means, self.filters.covariances, self.filters.priors

    def _estimate(self) -> Estimate:
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        summarise(self._moments, out)
        return Estimate(*out)

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self.filters.priors[episodes] = self.model.project(states, self.settings.bounds)
        self._restart(episodes)

    def _means_of(self, episodes: IntArray) -> FloatArray:
        return self.filters.means[episodes]

    def _restart(self, episodes: IntArray) -> None:
        """Reset episodes to their priors."""
        for episode in episodes.tolist():
            restart(self.filters, episode)


class Linearised(NamedTuple):
    """Channels of a measurement, linearised at a prediction and normalised."""

    weights: FloatArray  # (M, 2, 2 x largest span) of the components from 2 `first` on
    residuals: FloatArray  # (M, 2)
    noise: FloatArray  # (M, 2) variances


@kernel
def predict(bundle: Bundle, episodes: IntArray, inputs: FloatArray) -> None:
    """Predict one step ahead under inputs `(k, n_u)`."""
    road, arz, _, filters = bundle.parts
    scratch, noise = make_scratch(road), np.empty(filters.units.size)
    slopes = np.empty(road.n_segments)
    blocks = np.empty((*road.neighbours.shape, 4))
    work = np.empty((2, *filters.covariances.shape[1:]))
    for k in range(episodes.size):
        mean, covariance = filters.means[episodes[k]], filters.covariances[episodes[k]]
        process_noise(road, filters, mean, noise, slopes)
        # x = f(x, u) and A = df/dx
        advance(road, arz, mean, inputs[k], mean, blocks, scratch)
        project(road, arz, mean, filters.is_box)
        normalise(arz, filters.units[0], blocks, scratch.by_factor)
        # P = A P A' + Q
        mirror(covariance)
        propagate(road, blocks, scratch.by_factor, noise, slopes, covariance, work, covariance)


@kernel_part
def process_noise(
    road: Road, filters: Any, mean: FloatArray, variance: FloatArray, slopes: FloatArray
) -> None:
    """Write the process noise of a step that leaves a mean `(n_x,)`, as `add_noise` takes it.

    Args:
        road: The road.
        filters: `Filters`, or what has the same units and variances.
        mean: The mean.
        variance: `(n_x,)`, written.
        slopes: `(S,)`, written.
    """
    copy_vector(filters.process_variance, variance)
    of_vehicles, of_psi = filters.vehicle_variance[0], filters.vehicle_variance[1]
    for s in range(road.n_segments):
        i, j = 2 * s, 2 * s + 1
        slopes[s], rho = 0.0, mean[i] / filters.units[i]
        if (of_vehicles > 0.0 or of_psi > 0.0) and rho > 0.0:
            # The sum of [[c, 0], [0, d]], of a rho [[1, w], [w, w^2]] and of [[0, 0], [0, b rho]].
            w = min(mean[j] / filters.units[j] / rho, LARGEST_W)
            alone, brought = variance[i], of_vehicles * rho
            variance[i] = alone + brought
            slopes[s] = w * brought / variance[i]
            variance[j] += of_psi * rho + w * slopes[s] * alone


@kernel
def update(bundle: Bundle, episodes: IntArray, measured: Measurement) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, arz, channels, filters = bundle.parts
    n_channels, width, longest = channels.first.size, filters.covariances.shape[2], 1
    for m in range(n_channels):
        longest = max(longest, channels.span[m])
    weights = np.empty((n_channels, 2, 2 * longest))
    linear = Linearised(weights, np.empty((n_channels, 2)), np.empty((n_channels, 2)))
    shift, work = np.empty(width), np.empty((4, width))
    for k in range(episodes.size):
        e, observed = episodes[k], measured.observed[k]
        mean, covariance = filters.means[e], filters.covariances[e]
        _linearise(arz, channels, filters, e, measured, k, linear)
        _innovate(channels, filters, e, observed, linear)
        sound = True
        if any_of(observed):
            sound = _assimilate(channels, covariance, observed, linear, shift, work)
            for i in range(mean.size):
                mean[i] += shift[i] * filters.units[i]
            project(road, arz, mean, filters.is_box)
        filters.diverged[e] = not (sound and all_finite(mean) and is_covariance(covariance, shift))
        if filters.diverged[e]:
            restart(filters, e)


@inline_part
def _linearise(
    arz: ARZ,
    channels: Channels,
    filters: Filters,
    e: int,
    measured: Measurement,
    k: int,
    linear: Linearised,
) -> None:
    """Write the weights, residuals and noise of what is observed at an episode's mean."""
    mean, units, centre = filters.means[e], filters.units, measured.centre[k]
    values, sigma = measured.values[k], measured.sigma[k]
    for m in range(channels.first.size):
        if not measured.observed[k, m]:
            continue
        weights, residuals = linear.weights[m], linear.residuals[m]
        first, span = 2 * channels.first[m], channels.span[m]
        write_channel(arz, channels, units, mean, centre, m, weights, residuals)
        density = 0.0
        for i in range(2 * span):
            x = mean[first + i] / units[first + i]
            density += weights[0, i] * x
            residuals[1] += weights[1, i] * x
        residuals[0] = values[m, 0] / units[0] - density
        residuals[1] = values[m, 1] / arz.second_scale - residuals[1]
        linear.noise[m, 0] = (sigma[m, 0] / units[0]) ** 2
        linear.noise[m, 1] = (sigma[m, 1] / arz.second_scale) ** 2


@inline_part
def _innovate(
    channels: Channels, filters: Filters, e: int, observed: BoolArray, linear: Linearised
) -> None:
    """Write residuals over their predicted deviations."""
    covariance, innovations = filters.covariances[e], filters.innovations[e]
    for m in range(observed.size):
        fill_vector(innovations[m], 0.0)
        if not observed[m]:
            continue
        first, size = 2 * channels.first[m], 2 * channels.span[m]
        for q in range(2):
            variance = linear.noise[m, q]  # S = R + h' P h
            for i in range(size):
                along = 0.5 * linear.weights[m, q, i] * covariance[first + i, first + i]
                for j in range(i):
                    along += linear.weights[m, q, j] * covariance[first + i, first + j]
                variance += 2.0 * linear.weights[m, q, i] * along
            innovations[m, q] = linear.residuals[m, q] / np.sqrt(variance)


@kernel_part
def find_observed(observed: BoolArray, indices: IntArray) -> IntArray:
    """Return the channels that are observed, which are written to the start of `indices` `(M,)`."""
    n_seen = 0
    for m in range(indices.size):
        if observed[m]:
            indices[n_seen] = m
            n_seen += 1
    return indices[:n_seen]


@kernel_part(fastmath={"contract"})
def _assimilate(
    channels: Channels,
    covariance: FloatArray,
    observed: BoolArray,
    linear: Linearised,
    shift: FloatArray,
    work: FloatArray,
) -> bool:
    """Update a covariance by what is observed, and write the normalised change of the mean.

    Returns:
        Whether all variances of the measured numbers are sound.
    """
    fill_vector(shift, 0.0)
    for m in range(observed.size):
        if not observed[m]:
            continue
        first, size = 2 * channels.first[m], 2 * channels.span[m]
        weights = linear.weights[m, :, :size]
        if not pair_update(covariance, first, weights, linear.noise[m], work):
            return False
        # x = x + K_q (z_q - h_q(x_0) - h_q' (x - x_0)), by one number q after the other
        for q in range(2):
            residual = linear.residuals[m, q]
            for i in range(size):
                residual -= weights[q, i] * shift[first + i]
            for j in range(shift.size):
                shift[j] += residual * work[2 + q, j]
    return True


@kernel
def restart(filters: Filters, episode: int) -> None:
    """Reset an episode's filter to its prior."""
    copy_vector(filters.priors[episode], filters.means[episode])
    for innovations in filters.innovations[episode]:
        fill_vector(innovations, 0.0)
    covariance = filters.covariances[episode]
    for i in range(covariance.shape[0]):
        fill_vector(covariance[i], 0.0)
        covariance[i, i] = filters.initial_variance[i]


@kernel
def summarise(bundle: Bundle, out: FloatArray) -> None:
    """Write density, speed and their standard deviations to `out` `(4, n, S)`, physical units."""
    road, arz, _, filters = bundle.parts
    v_f, gamma = arz.free_flow_speed, arz.gamma
    for e in range(filters.means.shape[0]):
        covariance = filters.covariances[e]
        for s in range(road.n_segments):
            i, j, jam = 2 * s, 2 * s + 1, arz.jam[s]
            rho, psi = filters.means[e, i], filters.means[e, j]
            w = psi / rho if rho > VACUUM * jam else v_f
            # v = w - p(rho), w = psi / rho; var v = (dv/drho, dv/dpsi) P (dv/drho, dv/dpsi)'
            _, by_rho, by_psi = floored_speed(rho, psi, jam, v_f, gamma)
            a, b = by_rho * filters.units[i], by_psi * filters.units[j]
            variance = a * (a * covariance[i, i] + 2.0 * b * covariance[j, i])
            variance += b * b * covariance[j, j]
            out[0, e, s] = rho
            out[1, e, s] = clip(w - pressure(rho, jam, v_f, gamma), 0.0, LARGEST_W * v_f)
            out[2, e, s] = filters.units[i] * np.sqrt(max(covariance[i, i], 0.0))
            out[3, e, s] = np.sqrt(max(variance, 0.0))


class EKF(CovarianceFilter):
    """Extended Kalman filter on the ARZ model: analytic Jacobians, sequential Joseph updates.

    All channels of a step are linearised at its prediction, so that updating by one after the other
    equals the joint update by all, in whichever order. Means are projected after predict and
    update; covariances are not.
    """

    predict_kernel = staticmethod(predict)
    update_kernel = staticmethod(update)


# Variances of the noise and of the prior, normalised: rho by rho_m, psi by rho_m v_f --------------


def process_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the variances, shape (n_x,), of a step's process noise at a density of zero."""
    traffic = np.tile(np.square(settings.process_noise), model.n_segments)
    deviation = 0.0 if settings.demand is None else settings.demand.deviation
    # With this noise the variance of a factor stays that of its prior.
    variance = deviation**2 * (1.0 - model.arz.kept**2)
    return np.concatenate([traffic, np.full(model.n_demand_states, variance)])


def initial_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the variances, shape (n_x,), of the prior."""
    traffic = np.full(2 * model.n_segments, settings.initial_variance)
    deviation = 0.0 if settings.demand is None else settings.demand.deviation
    return np.concatenate([traffic, np.full(model.n_demand_states, deviation**2)])
