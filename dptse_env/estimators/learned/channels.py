"""The inputs of a recurrent network: its own prediction, and what releases say against it.

A release is read as a Kalman filter would read it that takes the errors of different cells, and of
density and speed, as independent. A row m of a measurement averages over its cells two numbers:
densities rho, and y = rho (v - centre) where flows are released, or y = v where speeds are. The
prediction of a cell has the variances P_rho, P_v and hence P_y. With the variance V_m of the row's
innovation e_m, the measured less the predicted average, noise included, a cell's gain and
correction are, over the rows that cover it,

    K_ms = P_s / (span_m V_m)      d_s = sum_m K_ms e_m

The network gets innovations over their deviations, corrections and gains. So the deviation of the
noise, which ranges over three orders of magnitude between mechanisms and budgets, is weighed before
the network sees a release.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators.batch import Measurements
from dptse_env.model.network import MeasurementRows

CHANNELS = (
    "queried", "share", "log_density_sigma", "log_second_sigma", "predicted_density",
    "predicted_speed", "log_density_deviation", "log_speed_deviation", "density_innovation",
    "second_innovation", "density_correction", "density_correction_by_flow", "speed_correction",
    "density_gain", "speed_gain", "slip", "flows", "log_age", "inflow", "outside_density",
    "on_ramp", "off_ramp", "entry", "exit", "lanes", "log_length", "log_limit",
)  # fmt: skip
"""The inputs of the network for each cell."""

LONGEST_AGE = 300.0
"""Seconds since a measurement after which a cell counts as never measured."""
LEAST_SIGMA, LARGEST_SIGMA = 0.1, 1e6
"""Range of deviations whose logarithms the network sees [veh/km, km/h or veh/h]."""
LEAST_VARIANCE = 1e-12
LARGEST_INNOVATION = 6.0
"""Largest innovation, in deviations, that the network sees."""
LARGEST_CORRECTION = 2.0
"""Largest correction that the network sees, in units of density or speed limits."""


class Rows(NamedTuple):
    """The rows of a measurement; for k episodes of different roads with a leading axis."""

    covers: Any  # (M, S) flags of the cells that each row covers
    share: Any  # (M,) 1 / number of these cells


class Released(NamedTuple):
    """Measurements of a second in k episodes; values and sigma are 0 where there is none."""

    observed: Any  # (k, M), 1 or 0
    values: Any  # (k, M, 2)
    sigma: Any  # (k, M, 2)
    centre: Any  # (k, S), 0 where speeds are released


def make_rows(rows: MeasurementRows) -> Rows:
    """Return a model's rows as `read_rows` takes them."""
    return Rows((rows.weights > 0.0).astype(float), 1.0 / rows.span)


def make_released(measured: Measurements) -> Released:
    """Return measurements as `read_rows` takes them."""
    seen = measured.observed[..., None]
    return Released(
        measured.observed.astype(float),
        np.where(seen, measured.values, 0.0),
        np.where(seen, measured.sigma, 0.0),
        np.nan_to_num(measured.centre),
    )


def read_rows(
    xp: ModuleType, cells: Any, rows: Rows, released: Released, predicted: Any, age: Any
) -> tuple[Any, Any]:
    """Return the channels that come of releases, (k, S, 18), and the innovations (k, M, 2).

    Args:
        xp: numpy or torch, of which the other arguments are arrays.
        cells: Has ``unit`` (S,), ``limit`` and ``flows`` (1 or 0, or (k, 1) of them).
        rows: The rows of the measurement.
        released: The measurement.
        predicted: Predicted density [veh/km], speed [km/h] and their deviations, shape (k, S, 4).
        age: Seconds since the last measurement before this one, shape (k, S).
    """
    flows, unit, limit = cells.flows, cells.unit, cells.limit
    density, speed = predicted[..., 0], predicted[..., 1]
    density_variance, speed_variance = predicted[..., 2] ** 2, predicted[..., 3] ** 2
    slip = flows * (speed - released.centre)  # derivative of y by the density
    by_speed = flows * density + (1.0 - flows)  # derivative of y by the speed
    second = flows * density * slip + (1.0 - flows) * speed
    second_variance = by_speed**2 * speed_variance + slip**2 * density_variance
    innovations, sums = _weigh(
        xp, rows, released, [density, second], [density_variance, second_variance]
    )
    count = sums[..., 0]
    queried, each = xp.clip(count, None, 1.0), 1.0 / xp.clip(count, 1.0, None)
    log_unit = xp.log(unit)
    table = [
        queried,
        sums[..., 1],
        0.2 * (sums[..., 2] * each - queried * log_unit),
        0.2 * (sums[..., 3] * each - queried * (flows * log_unit + math.log(limit))),
        density / unit,
        speed / limit,
        0.25 * xp.log(predicted[..., 2] / unit),
        0.25 * xp.log(predicted[..., 3] / limit),
        0.5 * _held(xp, sums[..., 4], LARGEST_INNOVATION),
        0.5 * _held(xp, sums[..., 5], LARGEST_INNOVATION),
        4.0 * _held(xp, density_variance * sums[..., 6] / unit, LARGEST_CORRECTION),
        4.0 * _held(xp, slip * density_variance * sums[..., 7] / unit, LARGEST_CORRECTION),
        4.0 * _held(xp, by_speed * speed_variance * sums[..., 7] / limit, LARGEST_CORRECTION),
        xp.clip(density_variance * sums[..., 8], None, 1.0),
        xp.clip(by_speed**2 * speed_variance * sums[..., 9], None, 1.0),
        slip / limit,
        queried * 0.0 + flows,
        0.25 * xp.log(1.0 + xp.clip(age, 0.0, LONGEST_AGE)),
    ]
    return xp.stack(table, -1), innovations


def _weigh(
    xp: ModuleType, rows: Rows, released: Released, values: Any, variances: Any
) -> tuple[Any, Any]:
    """Return innovations over their deviations (k, M, 2), and sums over rows for each cell.

    The sums (k, S, 10) are over the rows that cover a cell: their number, their shares, logarithms
    of sigma, innovations, then e_m / (span_m V_m) and 1 / (span_m^2 V_m); the last four have a
    column for densities and one for the second number.
    """
    observed, share = released.observed, rows.share
    means = _sums(xp, rows.covers, values) * share[..., None]
    total = _sums(xp, rows.covers, variances) * share[..., None] ** 2 + released.sigma**2
    total = xp.clip(total, LEAST_VARIANCE, None)
    errors = observed[..., None] * (released.values - means)
    innovations = errors / xp.sqrt(total)
    weights = (observed * share)[..., None] / total
    sigma = observed[..., None] * xp.log(xp.clip(released.sigma, LEAST_SIGMA, LARGEST_SIGMA))
    tables = [sigma, innovations, weights * errors, share[..., None] * weights]
    columns = [table[..., j] for table in tables for j in range(2)]
    back = xp.swapaxes(rows.covers, -1, -2)
    return innovations, _sums(xp, back, [observed, observed * share, *columns])


def _sums(xp: ModuleType, weights: Any, columns: Any) -> Any:
    return xp.matmul(weights, xp.stack(columns, -1))


def _held(xp: ModuleType, values: Any, largest: float) -> Any:
    return xp.clip(values, -largest, largest)
