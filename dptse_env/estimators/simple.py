"""Baselines of estimators: a random walk, its blend with an EKF, and the traffic model alone."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from dptse_env.estimators.base import (
    Estimate,
    Estimator,
    KernelEstimator,
    Measurement,
    estimated_traffic,
)
from dptse_env.estimators.ekf import EKF
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.parameters import MEASUREMENT_FLOOR
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, kernel, kernel_part


class Walks(NamedTuple):
    """Scalar filters of n episodes."""

    means: FloatArray  # (n, S, 2) [veh/km, km/h]
    variances: FloatArray  # (n, S, 2)
    priors: FloatArray  # (n, S, 2) prior means
    innovations: FloatArray  # (n, M, 2)
    diverged: BoolArray  # (n,)
    largest: FloatArray  # (S, 2) largest means
    process_variance: FloatArray  # (2,) of a step
    initial_variance: FloatArray  # (2,)


@kernel
def restart(bundle: Bundle, episodes: IntArray) -> None:
    """Reset episodes `(k,)` to their priors."""
    _, walks = bundle.parts
    for e in episodes:
        _restart(walks, e)


@kernel_part
def _restart(walks: Walks, e: int) -> None:
    walks.means[e] = walks.priors[e]
    walks.variances[e] = walks.initial_variance
    walks.innovations[e] = 0.0


@kernel
def predict(bundle: Bundle, episodes: IntArray, inputs: FloatArray) -> None:  # noqa: ARG001
    """Add the variance of a step."""
    _, walks = bundle.parts
    for e in episodes:
        walks.variances[e] += walks.process_variance


@kernel
def update(bundle: Bundle, episodes: IntArray, measured: Measurement) -> None:
    """Update episodes `(k,)` by one channel after the other, by its density, then its other number.

    Either is a sum of its segments' densities or speeds, of known weights. The variances are in
    Joseph form, in which no nearly equal numbers are subtracted.
    """
    channels, walks = bundle.parts
    first, span, largest = channels.first, channels.span, walks.largest
    innovations, diverged = walks.innovations, walks.diverged
    weights = np.empty(largest.shape[0])
    for k in range(episodes.size):
        mean, variance = walks.means[episodes[k]], walks.variances[episodes[k]]
        centre = measured.centre[k]
        innovations[episodes[k]] = 0.0
        diverged[episodes[k]] = False
        for m in range(first.size):
            if not measured.observed[k, m]:
                continue
            for i in range(2):
                residual, noise = measured.values[k, m, i], measured.sigma[k, m, i] ** 2
                spread = 0.0
                for s in range(first[m], first[m] + span[m]):
                    weights[s] = 1.0 / span[m]
                    if i == 1 and not np.isnan(centre[s]):
                        weights[s] *= max(mean[s, 0], MEASUREMENT_FLOOR * largest[s, 0])
                        residual += weights[s] * centre[s]
                    residual -= weights[s] * mean[s, i]
                    spread += weights[s] ** 2 * variance[s, i]
                total = spread + noise
                diverged[episodes[k]] |= not np.isfinite(residual)
                if not 0.0 < total < np.inf:
                    continue
                innovations[episodes[k], m, i] = residual / np.sqrt(total)
                for s in range(first[m], first[m] + span[m]):
                    h, before = weights[s], variance[s, i]
                    gain = h * before / total
                    others = noise + (spread - h**2 * before)
                    mean[s, i] = min(max(mean[s, i] + gain * residual, 0.0), largest[s, i])
                    variance[s, i] = (1.0 - gain * h) ** 2 * before + gain**2 * others
        if diverged[episodes[k]]:
            _restart(walks, episodes[k])


class RandomWalk(KernelEstimator):
    """Independent scalar Kalman filters on (rho, v) of each segment, without a traffic model.

    Means are clipped to [0, rho_m] and [0, 1.1 v_f]. A released flow rho (v - v_0) is converted to
    a speed by the density just estimated, which is treated as exact and at least a hundredth of
    rho_m. A channel of several segments corrects each of them by its share of the uncertainty; the
    covariance of their errors is dropped.

    Attributes:
        means: Densities [veh/km] and speeds [km/h], `(n, S, 2)`.
        variances: Of these, `(n, S, 2)`.
    """

    has_demand: ClassVar[bool] = False
    steps_model: ClassVar[bool] = False
    predict_kernel = staticmethod(predict)
    update_kernel = staticmethod(update)

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        scale = np.array([model.density_scale, model.speed_scale])
        initial_variance = settings.initial_variance * scale**2
        speeds = np.full(model.n_segments, model.largest_speed)
        shape = (n_episodes, model.n_segments, 2)
        self._walks = Walks(
            means=np.zeros(shape),
            variances=np.broadcast_to(initial_variance, shape).copy(),
            priors=np.zeros(shape),
            innovations=self.innovations,
            diverged=self.diverged,
            largest=np.stack([model.jam_density, speeds], axis=-1),
            process_variance=(np.array(settings.walk_noise) * scale) ** 2,
            initial_variance=initial_variance,
        )
        self.means, self.variances = self._walks.means, self._walks.variances
        self.arrays = Bundle(model.channels, self._walks)

    @property
    def states(self) -> FloatArray:
        """Means `(n, 2 S)` [veh/km, veh/h]."""
        return self.model.states(self.means[..., 0], self.means[..., 1])

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f.

        To first order: `traffic_jacobian` turns them into the variances of density and speed.
        """
        inverse = np.linalg.inv(self.model.traffic_jacobian(self.states))
        inverse /= self.model.state_scale[:2, None]
        blocks = inverse * self.variances[..., None, :] @ inverse.swapaxes(-1, -2)
        n_episodes, n_segments = self.means.shape[:2]
        joint = np.zeros((n_episodes, n_segments, 2, n_segments, 2))
        every = np.arange(n_segments)
        joint[:, every, :, every] = blocks.swapaxes(0, 1)
        return joint.reshape(n_episodes, 2 * n_segments, 2 * n_segments)

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return self._walks.means, self._walks.variances, self._walks.priors

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        traffic = np.stack(estimated_traffic(self.model, states), axis=-1)
        self._walks.priors[episodes] = np.clip(traffic, 0.0, self._walks.largest)
        restart(self.arrays, episodes)

    def _estimate(self) -> Estimate:
        deviations = np.sqrt(self.variances)
        columns = [table[..., i].copy() for table in (self.means, deviations) for i in range(2)]
        return Estimate(*columns)


class Blend(Estimator):
    """An EKF and a random walk on the same measurements, and the weighted mean of what they report.

    With x_1 the EKF's density (or speed), x_2 the walk's and c the weight of `BlendSettings`, the
    estimate is `c x_1 + (1 - c) x_2` and its standard deviation `c s_1 + (1 - c) s_2`: that of
    perfectly correlated errors, the largest for errors of deviations s_1 and s_2. Both parts read
    the same releases, so that their errors are far from independent.

    A ``speed_cap`` holds the speeds of each part. `innovations` are the weighted means of the
    parts' own. Where a part diverges, both are reset to their prior.

    Attributes:
        ekf: The EKF.
        walk: The random walk.
    """

    is_compiled: ClassVar[bool] = True

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self.ekf = EKF(model, n_episodes, settings)
        self.walk = RandomWalk(model, n_episodes, settings)
        self._priors = np.zeros((n_episodes, 2 * model.n_segments))
        self._weights = np.array([settings.blend.density_weight, settings.blend.speed_weight])

    @property
    def states(self) -> FloatArray:
        """The EKF's means `(n, n_x)` [veh/km, veh/h], then demand factors if there are any."""
        return self.ekf.states

    @property
    def covariances(self) -> FloatArray:
        """The EKF's covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f."""
        return self.ekf.covariances

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return *self.ekf.memory, *self.walk.memory, self._priors

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._priors[episodes] = states[:, : self._priors.shape[1]]
        self._restart(episodes)

    def _restart(self, episodes: IntArray) -> None:
        for part in (self.ekf, self.walk):
            part.reset(episodes, self._priors[episodes], ())  # neither part draws

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        for part in (self.ekf, self.walk):
            part._predict(episodes, inputs)

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        for part in (self.ekf, self.walk):
            part._update(episodes, measured)
        c = self._weights
        first, second = self.ekf.innovations[episodes], self.walk.innovations[episodes]
        self.innovations[episodes] = c * first + (1.0 - c) * second
        self.diverged[episodes] = self.ekf.diverged[episodes] | self.walk.diverged[episodes]
        lost = episodes[self.diverged[episodes]]
        if lost.size > 0:
            self.innovations[lost] = 0.0
            self._restart(lost)

    def _estimate(self) -> Estimate:
        one, other = self.ekf.estimate(), self.walk.estimate()
        of_density, of_speed = self._weights.tolist()
        return Estimate(
            _mean(of_density, one.density, other.density),
            _mean(of_speed, one.speed, other.speed),
            _mean(of_density, one.density_std, other.density_std),
            _mean(of_speed, one.speed_std, other.speed_std),
        )


def _mean(weight: float, one: FloatArray, other: FloatArray) -> FloatArray:
    return weight * one + (1.0 - weight) * other


class OpenLoop(Estimator):
    """Predictions of the model from the prior; measurements are ignored.

    Standard deviations and innovations are zero. An episode whose state has become non-finite is
    reset to its prior at the next update.

    Attributes:
        states: `(n, 2 S)` [veh/km, veh/h].
    """

    has_demand: ClassVar[bool] = False

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self.states = model.project(np.zeros((n_episodes, model.n_states)), settings.bounds)
        self._priors = self.states.copy()

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return self.states, self._priors

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._priors[episodes] = self.model.project(states, self.settings.bounds)
        self.states[episodes] = self._priors[episodes]

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        after = self.model.step(self.states[episodes], inputs)
        self.states[episodes] = self.model.project(after, self.settings.bounds)

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        self.diverged[episodes] = ~np.all(np.isfinite(self.states[episodes]), axis=1)
        lost = episodes[self.diverged[episodes]]
        self.states[lost] = self._priors[lost]

    def _estimate(self) -> Estimate:
        density, speed = estimated_traffic(self.model, self.states)
        return Estimate(density, speed, np.zeros_like(density), np.zeros_like(speed))
