"""Compiled kernels of the moving horizon estimator, episode by episode."""

import math

import numpy as np

from dptse_env.estimators.compiled import ekf_kernels as kernels
from dptse_env.estimators.compiled.active_set import make_active_set, minimise
from dptse_env.estimators.compiled.chain import make_window_scratch
from dptse_env.estimators.compiled.ekf_kernels import Filters, Packed, process_noise
from dptse_env.estimators.compiled.ekf_rows import row_variances
from dptse_env.estimators.compiled.moments import is_finite
from dptse_env.estimators.compiled.stages import (
    UNSOLVED,
    Windows,
    chain_of,
    enter,
    linearise_measurement,
    linearise_step,
    shift,
)
from dptse_env.estimators.compiled.window import factorise
from dptse_env.model.network import RoadArrays
from dptse_env.model.step import advance, make_scratch, project, released
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import all_finite, any_of, copy_matrix, copy_vector
from dptse_env.utils.kernels import kernel, kernel_part


@kernel
def restart(filters_: Packed, windows_: Packed, episode: int) -> None:
    """Reset an episode to a window of a single stage, its prior."""
    filters, windows = Filters(*filters_), Windows(*windows_)
    kernels.restart(filters, episode)
    windows.length[episode], windows.updated[episode] = 1, 0
    copy_vector(filters.initial_variance, windows.arrival_variance[episode])
    enter(filters, windows, episode, 0)
    copy_vector(windows.solution[episode, 0], windows.point[episode])
    windows.rounds[episode] = 0


@kernel
def predict(
    road_: Packed, filters_: Packed, windows_: Packed, episodes: IntArray, inputs: FloatArray
) -> None:
    """Append the model's prediction, under inputs `(k, n_u)`, to each window."""
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    scratch = make_scratch(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    state = np.empty(filters.means.shape[1])
    for k in range(episodes.size):
        e = episodes[k]
        if windows.length[e] == windows.solution.shape[1]:  # there was no update
            shift(windows, e)
        length, point = windows.length[e], windows.point[e]
        for i in range(point.size):
            total = 0.0
            for t in range(length):
                total += windows.solution[e, t, i]
            point[i] = total / length
        copy_vector(filters.means[e], state)
        process_noise(road, filters, state, windows.process_variance[e, length - 1])
        project(road, state, False)
        advance(road, state, inputs[k], state, blocks, scratch)
        project(road, state, filters.is_box)
        copy_vector(state, filters.means[e])
        copy_vector(inputs[k], windows.inputs[e, length - 1])
        if not windows.along:
            linearise_step(road, filters, windows, e, length - 1, point)
        windows.length[e] = length + 1
        enter(filters, windows, e, length)


@kernel
def write_sides(windows: Windows, e: int, z: FloatArray) -> None:
    """Write at which bound each variable of a solution `(L, padded)` is."""
    for t in range(windows.length[e]):
        for i in range(windows.units.size):
            at_lower, at_upper = z[t, i] <= windows.lower[i], z[t, i] >= windows.upper[i]
            windows.side[e, t, i] = int(at_upper) - int(at_lower)


@kernel
def update(
    road_: Packed,
    filters_: Packed,
    windows_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> None:
    """Update by measurements, `sigma` no less than allowed; see `Estimator.update`."""
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    capacity, width = windows.solution.shape[1:]
    scratch = make_window_scratch(road, capacity - 1, windows.units.size, width)
    active = make_active_set(capacity - 1, width)
    for k in range(episodes.size):
        e = episodes[k]
        sound = enter_measurements(
            road, filters, windows, e, observed[k], values[k], sigma[k], centre[k]
        )
        length, chain = windows.length[e], chain_of(windows, e)
        if sound and factorise(road, chain, length, scratch):
            copy_matrix(scratch.factors[length - 1], filters.covariances[e])
            innovate(road, filters, windows, e, scratch.before)
            if any_of(observed[k]):
                side = windows.side[e, : capacity - 1]
                copy_matrix(side, active.side)
                z = windows.solution[e].copy()
                rounds = minimise(
                    road, chain, length, scratch, windows.lower, windows.upper, active, z
                )
                windows.rounds[e] = rounds
                if rounds != UNSOLVED:
                    copy_matrix(active.side, side)
                    accept(road, filters, windows, e, z)
            # An optimum that is not finite has no residual and counts as unsolved.
            sound = is_finite(filters.covariances[e])
        else:
            sound = False
        filters.diverged[e] = not sound
        if not sound:
            restart(filters_, windows_, e)


@kernel_part(kept=True)
def enter_measurements(
    road: RoadArrays,
    filters: Filters,
    windows: Windows,
    e: int,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> bool:
    """Add measurements to the last stage, and linearise; return whether all is finite."""
    if windows.length[e] == windows.solution.shape[1]:
        shift(windows, e)
    last = windows.length[e] - 1
    copy_vector(observed, windows.observed[e, last])
    copy_vector(centre, windows.centre[e, last])
    windows.rounds[e] = 0
    sound = _measure(road, filters, windows, e, values, sigma)
    _linearise(road, filters, windows, e)
    return sound


@kernel_part(kept=True)
def _linearise(road: RoadArrays, filters: Filters, windows: Windows, e: int) -> None:
    """Linearise the last stage, or all stages where that is along the solution."""
    last = windows.length[e] - 1
    if not windows.along:
        linearise_measurement(road, filters, windows, e, last, windows.point[e])
        return
    for t in range(last + 1):
        point = windows.solution[e, t]
        linearise_measurement(road, filters, windows, e, t, point)
        if t < last:
            linearise_step(road, filters, windows, e, t, point)


@kernel_part(kept=True)
def _measure(
    road: RoadArrays,
    filters: Filters,
    windows: Windows,
    e: int,
    values: FloatArray,
    sigma: FloatArray,
) -> bool:
    """Write values and noise of the last stage; return whether they and the mean are finite."""
    last, mean = windows.length[e] - 1, filters.means[e]
    sound = all_finite(mean)
    for m in range(road.row_first.size):
        first, span = road.row_first[m], road.row_span[m]
        for j in range(2):
            unit = filters.density_scale if j == 0 else road.second_scale
            value = values[m, j] / unit if windows.observed[e, last, m] else 0.0
            windows.values[e, last, m, j] = value
            windows.noise[e, last, m, j] = (sigma[m, j] / unit) ** 2
            sound = sound and math.isfinite(value)
        density = 0.0
        for s in range(first, first + span):
            density += mean[2 * s]
        windows.noise[e, last, m, 0] += filters.count_variance[m] * density / span**2
    return sound


@kernel
def accept(road: RoadArrays, filters: Filters, windows: Windows, e: int, z: FloatArray) -> None:
    """Accept a solution `(L, padded)`, whose last state is the estimate."""
    copy_matrix(z, windows.solution[e])
    last = windows.length[e] - 1
    for i in range(windows.units.size):
        filters.means[e, i] = z[last, i] * windows.units[i]
    project(road, filters.means[e], filters.is_box)


@kernel_part
def innovate(
    road: RoadArrays, filters: Filters, windows: Windows, e: int, before: FloatArray
) -> None:
    """Write residuals at the prediction over the deviations that the window expects.

    `before` has the covariances, before the measurements, of each row's segments.
    """
    last = windows.length[e] - 1
    scale, unit = filters.density_scale, road.second_scale
    innovations, slopes = filters.innovations[e], windows.slopes[e, last]
    innovations[:] = 0.0
    for m in range(road.row_first.size):
        if not windows.observed[e, last, m]:
            continue
        first, span, noise = road.row_first[m], road.row_span[m], windows.noise[e, last, m]
        density, second = 0.0, 0.0
        for s in range(first, first + span):
            rho, psi = filters.means[e, 2 * s], filters.means[e, 2 * s + 1]
            density += rho
            second += released(road, s, rho, psi, windows.centre[e, last, s])[0]
        by_density, by_second = row_variances(before, first, span, slopes)
        values = windows.values[e, last, m]
        density = values[0] - density / span / scale
        second = values[1] - second / span / unit
        innovations[m, 0] = density / np.sqrt(by_density + noise[0])
        innovations[m, 1] = second / np.sqrt(by_second + noise[1])
