"""Compiled rows of a measurement, linearised at a mean: residuals, noise and derivatives.

A row is the average of one or several neighbouring segments. All of a `Rows` is normalised.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.compiled.algebra import sum_update
from dptse_env.model.network import RoadArrays
from dptse_env.model.step import released
from dptse_env.utils.arrays import BoolArray, FloatArray
from dptse_env.utils.kernels import kernel_part


class Rows(NamedTuple):
    """Linearised rows of a measurement, all normalised."""

    # (M, 4) residuals of both numbers, then for a single segment the derivatives of the second
    # number by its two components
    single: FloatArray
    noise: FloatArray  # (M, 2) variances
    slopes: FloatArray  # (S, 2) derivatives of each segment's second number by its components


@kernel_part
def make_rows(road: RoadArrays) -> Rows:
    """Allocate the rows of a measurement."""
    n_rows, n_segments = road.row_first.size, road.jam.size
    return Rows(np.empty((n_rows, 4)), np.empty((n_rows, 2)), np.zeros((n_segments, 2)))


@kernel_part
def linearise(
    road: RoadArrays,
    density_scale: float,
    count_variance: FloatArray,
    mean: FloatArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
    rows: Rows,
) -> None:
    """Write the residuals, the noise and the derivatives of the observed rows."""
    scale, unit = density_scale, road.second_scale
    for m in range(observed.size):
        if not observed[m]:
            continue
        first, span = road.row_first[m], road.row_span[m]
        density, second = 0.0, 0.0
        for s in range(first, first + span):
            rho, psi = mean[2 * s], mean[2 * s + 1]
            number, by_rho, by_psi = released(road, s, rho, psi, centre[s])
            density += rho
            second += number
            rows.slopes[s, 0] = by_rho * scale / unit
            rows.slopes[s, 1] = by_psi * scale * road.free_flow_speed / unit
        density /= span
        second /= span
        rows.single[m, 0] = (values[m, 0] - density) / scale
        rows.single[m, 1] = (values[m, 1] - second) / unit
        rows.single[m, 2], rows.single[m, 3] = rows.slopes[first, 0], rows.slopes[first, 1]
        rows.noise[m, 0] = (sigma[m, 0] / scale) ** 2 + count_variance[m] * density / span
        rows.noise[m, 1] = (sigma[m, 1] / unit) ** 2


@kernel_part(kept=True)
def innovate(
    road: RoadArrays,
    covariance: FloatArray,
    observed: BoolArray,
    rows: Rows,
    innovations: FloatArray,
) -> None:
    """Write residuals over their predicted deviations, before the update."""
    innovations[:] = 0.0
    for m in range(observed.size):
        if observed[m]:
            first, span = road.row_first[m], road.row_span[m]
            density, second = row_variances(covariance, first, span, rows.slopes)
            innovations[m, 0] = rows.single[m, 0] / np.sqrt(density + rows.noise[m, 0])
            innovations[m, 1] = rows.single[m, 1] / np.sqrt(second + rows.noise[m, 1])


@kernel_part
def row_variances(
    covariance: FloatArray, first: int, span: int, slopes: FloatArray
) -> tuple[float, float]:
    """Return the variances of a row's average density and average second number."""
    if span == 1:
        second = variance_along(covariance, first, slopes[first, 0], slopes[first, 1])
        return covariance[2 * first, 2 * first], second
    density, second = 0.0, 0.0
    for s in range(first, first + span):
        a, b = slopes[s, 0], slopes[s, 1]
        for t in range(first, first + span):
            c, d = slopes[t, 0], slopes[t, 1]
            density += covariance[2 * s, 2 * t]
            second += a * (c * covariance[2 * s, 2 * t] + d * covariance[2 * s, 2 * t + 1])
            second += b * (c * covariance[2 * s + 1, 2 * t] + d * covariance[2 * s + 1, 2 * t + 1])
    return density / span**2, second / span**2


@kernel_part
def variance_along(covariance: FloatArray, s: int, by_rho: float, by_psi: float) -> float:
    """Return the variance of a quantity with these derivatives by a segment's rho and psi."""
    a, b = covariance[2 * s, 2 * s], covariance[2 * s, 2 * s + 1]
    c = covariance[2 * s + 1, 2 * s + 1]
    return float(by_rho * by_rho * a + 2.0 * by_rho * by_psi * b + by_psi * by_psi * c)


@kernel_part(kept=True)
def update_wide(
    road: RoadArrays,
    covariance: FloatArray,
    observed: BoolArray,
    rows: Rows,
    shift: FloatArray,
    work: tuple[FloatArray, ...],
) -> bool:
    """Update by the observed rows of several segments; return whether their variances are sound.

    Next to `segment_update`, in one loop, `sum_update` would slow down a filter that has no such
    rows.
    """
    for m in range(observed.size):
        first, span = road.row_first[m], road.row_span[m]
        if observed[m] and span > 1:
            residuals, noise = rows.single[m, :2], rows.noise[m]
            if not sum_update(covariance, first, span, residuals, rows.slopes, noise, shift, work):
                return False
    return True
