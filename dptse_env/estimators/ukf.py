"""The unscented Kalman filter on the ARZ model.

With d_i the distances of the points from the first one, d = W sum d_i and W the weight of all
points but the first, the weighted covariance is `W sum d_i d_i' + (beta - alpha^2) d d'`: the large
negative weights of the first point cancel without rounding errors, and the joint covariance of
states and measurements is positive semidefinite by construction, also of projected points.

The points of a step have the process noise of earlier steps only: Q is added to P after their
prediction, and the next points are made from that. On a linear system this is the Kalman filter of
x' = F (x + w), with noise before the motion. Adding the derivative's `H Q H'` to the covariance of
measurements would place it after the motion; on recorded traffic that filter is no better, and much
worse at small alpha.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.base import Measurement
from dptse_env.estimators.ekf import (
    CovarianceFilter,
    Filters,
    find_observed,
    process_noise,
    restart,
)
from dptse_env.estimators.linalg import (
    add_noise,
    downdate,
    factor,
    forward,
    is_covariance,
    padded,
    products,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    measure_channel,
    project_states,
)
from dptse_env.model.step import project
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import (
    Bundle,
    all_finite,
    copy_matrix,
    fill_vector,
    kernel,
    kernel_part,
)
from dptse_env.utils.validation import require


class Points(NamedTuple):
    """Sigma points of n episodes."""

    # (n, n_x, width) projected points after the last prediction [veh/km, veh/h, demand factors]:
    # that of the mean, then pairs; columns beyond 2 n_x + 1 repeat the first
    states: FloatArray
    moved: BoolArray  # (n,) whether they were predicted since their last update
    weight: float  # W of every point but the first
    surplus: float  # beta - alpha^2
    spread: float  # points are the mean plus and minus spread times columns of a root of P


@kernel
def predict(bundle: Bundle, episodes: IntArray, inputs: FloatArray) -> None:
    """Predict one step ahead under inputs `(k, n_u)` by points that are made, moved, projected."""
    road, arz, _, filters, points = bundle.parts
    n, width = points.states.shape[1:]
    scratch, noise, shift = make_batch_scratch(road, width), np.empty(n), np.empty(n)
    slopes = np.empty(road.n_segments)
    root, distances = np.empty(filters.covariances.shape[1:]), np.empty((n, width))
    for k in range(episodes.size):
        e = episodes[k]
        mean, covariance, states = filters.means[e], filters.covariances[e], points.states[e]
        process_noise(road, filters, mean, noise, slopes)
        if not _draw(filters, points, e, root):
            fill_vector(mean, np.nan)  # detected by the update, which resets the filter
        advance_states(road, arz, states, inputs[k], scratch)
        project_states(road, arz, states, filters.is_box)
        _gather(filters, points, e, distances, shift)
        add_noise(noise, slopes, covariance)
        for i in range(n):
            mean[i] = states[i, 0] + shift[i] * filters.units[i]
        project(road, arz, mean, filters.is_box)
        points.moved[e] = True


@kernel_part
def _draw(filters: Filters, points: Points, e: int, root: FloatArray) -> bool:
    """Write an episode's points of its mean and covariance; return whether that is definite."""
    states, n = points.states[e], root.shape[0]
    copy_matrix(filters.covariances[e], root)
    if not factor(root):
        for i in range(n):
            fill_vector(states[i], np.nan)
        return False
    # x_0 = m, x_i = m +- sqrt(n + lambda) L_i with P = L L' (Wan and van der Merwe, 2000)
    for i in range(n):
        row, step = states[i], points.spread * filters.units[i]
        fill_vector(row, filters.means[e, i])
        root[i, i] = 1.0 / root[i, i]
        for k in range(i + 1):
            row[1 + k] += step * root[i, k]
            row[1 + n + k] -= step * root[i, k]
    return True


@kernel_part(fastmath={"contract", "reassoc"})
def _distances_from_first(row: FloatArray, unit: float, weight: float, out: FloatArray) -> float:
    """Write normalised distances from the first point and return their weighted sum."""
    first, inverse, total = row[0], 1.0 / unit, 0.0
    for j in range(row.size):
        out[j] = (row[j] - first) * inverse
        total += out[j]
    return weight * total


@kernel_part
def _gather(
    filters: Filters, points: Points, e: int, distances: FloatArray, shift: FloatArray
) -> None:
    """Write the lower half of an episode's covariance from its points.

    `distances` `(n_x, width)` are written with theirs from the first one, and `shift` `(n_x,)` with
    that of their mean, normalised.
    """
    covariance, states = filters.covariances[e], points.states[e]
    for i in range(shift.size):
        shift[i] = _distances_from_first(states[i], filters.units[i], points.weight, distances[i])
    products(distances, distances, True, covariance)
    # P = W sum d_i d_i' + (beta - alpha^2) d d'; see the module's docstring
    for i in range(shift.size):
        for j in range(i + 1):
            covariance[i, j] = (
                points.weight * covariance[i, j] + points.surplus * shift[i] * shift[j]
            )


@kernel
def update(bundle: Bundle, episodes: IntArray, measured: Measurement) -> None:
    """Update by measurements; see `Estimator.update`."""
    _, _, channels, filters, points = bundle.parts
    variances = np.empty(filters.covariances.shape[2])
    indices = np.empty(channels.first.size, np.int64)
    for k in range(episodes.size):
        e, seen, sound = episodes[k], find_observed(measured.observed[k], indices), True
        for innovations in filters.innovations[e]:
            fill_vector(innovations, 0.0)
        if seen.size > 0:
            sound = _assimilate(bundle, e, seen, measured, k)
        mean, covariance = filters.means[e], filters.covariances[e]
        filters.diverged[e] = not (
            sound and all_finite(mean) and is_covariance(covariance, variances)
        )
        if filters.diverged[e]:
            restart(filters, e)
            points.moved[e] = False


@kernel_part
def _assimilate(bundle: Bundle, e: int, seen: IntArray, measured: Measurement, k: int) -> bool:
    """Update episode e, the k-th one that was measured, and write innovations.

    Args:
        bundle: Road, model, channels, `Filters` and `Points`.
        e: The episode.
        seen: `(m,)` channels that are observed.
        measured: The measurement.
        k: Index of the episode in it.

    Returns:
        Whether the covariances of the points and of the measurements are definite.
    """
    road, arz, _, filters, points = bundle.parts
    states, mean, covariance = points.states[e], filters.means[e], filters.covariances[e]
    n, width = states.shape
    size, residual = 2 * seen.size, padded(n)  # the column of residuals
    distances, shift = np.empty((n, width)), np.empty(n)
    if points.moved[e]:
        for i in range(n):
            shift[i] = _distances_from_first(
                states[i], filters.units[i], points.weight, distances[i]
            )
    else:
        if not _draw(filters, points, e, covariance.copy()):
            return False
        project_states(road, arz, states, filters.is_box)
        _gather(filters, points, e, distances, shift)
    points.moved[e] = False
    outputs, output_shift = np.empty((size, width)), np.empty(size)
    joint, cross = np.empty((size, size)), np.zeros((size, residual + 8))
    noise = _measure(bundle, e, seen, measured, k, outputs, output_shift, cross)
    # S = W sum y_i y_i' + (beta - alpha^2) y y' + R and C = W sum y_i d_i' + (beta - alpha^2) y d'
    products(outputs, outputs, True, joint)
    products(outputs, distances, False, cross)
    for i in range(size):
        for j in range(i + 1):
            joint[i, j] = points.weight * joint[i, j]
            joint[i, j] += points.surplus * output_shift[i] * output_shift[j]
        joint[i, i] += noise[i]
        for j in range(n):
            cross[i, j] = points.weight * cross[i, j] + points.surplus * output_shift[i] * shift[j]
        filters.innovations[e, seen[i // 2], i % 2] = cross[i, residual] / np.sqrt(joint[i, i])
        if not joint[i, i] >= noise[i] * (1.0 - 1e-9):
            return False
    if not factor(joint):
        return False
    # x = x + C' S^-1 r and P = P - C' S^-1 C: with L L' = S, rows of [C, r] become [V, z], where
    # V' z = C' S^-1 r and V' V = C' S^-1 C.
    forward(joint, cross)
    for i in range(n):
        total = shift[i]
        for r in range(size):
            total += cross[r, i] * cross[r, residual]
        mean[i] = states[i, 0] + total * filters.units[i]
    downdate(covariance, cross)
    project(road, arz, mean, filters.is_box)
    return True


@kernel_part
def _measure(
    bundle: Bundle,
    e: int,
    seen: IntArray,
    measured: Measurement,
    k: int,
    outputs: FloatArray,
    shift: FloatArray,
    cross: FloatArray,
) -> FloatArray:
    """Write distances of what points measure `(2 m, width)`, and residuals; return noise."""
    _, arz, channels, filters, points = bundle.parts
    values, sigma, centre = measured.values[k], measured.sigma[k], measured.centre[k]
    units, noise = (filters.units[0], arz.second_scale), np.empty(outputs.shape[0])
    work, residual = np.empty(outputs.shape[1]), cross.shape[1] - 8
    for r in range(seen.size):
        m = seen[r]
        density, second = outputs[2 * r], outputs[2 * r + 1]
        measure_channel(arz, channels, m, points.states[e], centre, density, second, work)
        for q in range(2):
            i, number = 2 * r + q, outputs[2 * r + q]
            first = number[0]
            shift[i] = _distances_from_first(number, units[q], points.weight, number)
            cross[i, residual] = (values[m, q] - first) / units[q] - shift[i]
            noise[i] = (sigma[m, q] / units[q]) ** 2
    return noise


class UKF(CovarianceFilter):
    """Unscented Kalman filter (Wan and van der Merwe, 2000), the paper's weights.

    Points are made once per step, predicted and projected; mean, covariance and measurements are
    all computed from these points, without new ones for the update. Means are also projected after
    predict and update.
    """

    predict_kernel = staticmethod(predict)
    update_kernel = staticmethod(update)

    @staticmethod
    def check_settings(model: ARZModel, settings: EstimatorSettings) -> None:
        """Refuse points that the model's number of states does not allow."""
        n, kappa = model.n_states, settings.ukf.kappa
        require(n + kappa > 0.0, "estimator_settings.ukf.kappa", f"> -{n}", kappa)

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        alpha, beta, n = settings.ukf.alpha, settings.ukf.beta, model.n_states
        spread = alpha**2 * (n + settings.ukf.kappa)
        self._points = Points(
            states=np.zeros((n_episodes, n, padded(2 * n + 1))),
            moved=np.zeros(n_episodes, dtype=np.bool_),
            weight=0.5 / spread,
            surplus=beta - alpha**2,
            spread=float(np.sqrt(spread)),
        )
        self.arrays = Bundle(*model.dynamics, self.filters, self._points)

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return *super()._memory, self._points.states, self._points.moved

    def _restart(self, episodes: IntArray) -> None:
        self._points.moved[episodes] = False
        super()._restart(episodes)
