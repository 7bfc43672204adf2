"""On linear and Gaussian problems every filter equals the Kalman filter."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    EnsembleSettings,
    EstimatorSettings,
    HorizonSettings,
    Measurement,
    SigmaPointSettings,
    make_estimator,
)
from dptse_env.model import ARZModel
from tests.helpers import pairwise, stretch
from tests.model.oracle import PUBLISHED

from .helpers import random_streams

# One segment that nobody enters or leaves has linear dynamics.
V_F, RHO_M, TAU, V_0 = 102.0, 333.0, 60.0, 51.0
FLOOR, UNIT = 0.01 * RHO_M, np.array([RHO_M, RHO_M * V_F])
F = np.array([[1.0, 0.0], [V_F / TAU, 1.0 - 1.0 / TAU]])
NOISE, INITIAL, START = 2e-5, 1e-9, np.array([2.0, 200.0])
Q = np.diag((NOISE * UNIT) ** 2)
INPUTS = np.array([0.0, V_F, 1.2 * RHO_M])


class Sensor(NamedTuple):
    """A model whose measurement is H x + offset, and the deviations of its noise."""

    model: ARZModel
    H: np.ndarray
    offset: np.ndarray
    sigma: np.ndarray


SENSORS = {
    # Below the density that a measurement takes at least, the speed is linear in psi.
    "speed": Sensor(
        ARZModel(stretch(n_mainline=1).road, PUBLISHED),
        np.array([[1.0, 0.0], [0.0, 1.0 / FLOOR]]),
        np.array([0.0, -V_F * 0.01**2]),
        np.array([0.4, 6.0]),
    ),
    # Long segments, for the CFL condition; a pressure of (2 / 333)^10 is none.
    "flow": Sensor(
        ARZModel(
            stretch(n_mainline=1, segment_length=1.0).road,
            replace(PUBLISHED, gamma=10.0),
            centre=V_0,
        ),
        np.array([[1.0, 0.0], [-V_0, 1.0]]),
        np.zeros(2),
        np.array([0.4, 40.0]),
    ),
}


class Step(NamedTuple):
    mean: np.ndarray  # (n, 2)
    covariance: np.ndarray  # (n, 2, 2)
    innovations: np.ndarray  # (n, 2)


def measurements(sensor, n_steps):
    """Values `(K, 1, 1, 2)` around the steady state."""
    noise = sensor.sigma * np.random.default_rng(0).normal(size=(n_steps, 2))
    steady = np.array([2.0, 2.0 * V_F])
    return (sensor.H @ steady + sensor.offset + noise)[:, None, None]


def kalman(sensor, values, noise_first=False):
    """The Kalman filter of x' = F x + w, or of x' = F (x + w)."""
    H, R = sensor.H, np.diag(sensor.sigma**2)
    x, p, before = START, np.diag(INITIAL * UNIT**2), 0.0 * Q
    for z in values[:, 0, 0]:
        p = p + before
        x, p = F @ x, F @ p @ F.T
        if noise_first:
            before = Q
        else:
            p = p + Q
        s = H @ p @ H.T + R
        residual, gain = z - H @ x - sensor.offset, p @ H.T @ np.linalg.inv(s)
        x, p = x + gain @ residual, p - gain @ s @ gain.T
        assert 1.0 < x[0] < FLOOR
        assert x[1] < 1.1 * V_F * x[0]
        yield Step(x[None], (p + before)[None], (residual / np.sqrt(np.diag(s)))[None])


def of_estimator(name, backend, sensor, values, n=1, **settings):
    """Steps of n episodes that are told the same."""
    noise = {"process_noise": (NOISE, NOISE), "initial_variance": INITIAL}
    given = EstimatorSettings(**noise, **settings)
    estimator, everyone = make_estimator(name, backend, sensor.model, n, given), np.arange(n)
    estimator.reset(everyone, np.tile(START, (n, 1)), random_streams(n))
    for z in values:
        estimator.predict(everyone, np.tile(INPUTS, (n, 1)))
        seen, all_told = np.ones((n, 1), bool), np.tile(z, (n, 1, 1))
        estimator.update(everyone, Measurement.of(estimator.model, seen, all_told, sensor.sigma))
        covariances = estimator.covariances * np.outer(UNIT, UNIT)
        yield Step(estimator.states.copy(), covariances, estimator.innovations[:, 0].copy())


@pytest.mark.parametrize(
    ("name", "sensor", "backend"), pairwise(["ekf", "ukf"], SENSORS, BACKENDS, n=4)
)
def test_ekf_and_ukf_are_the_kalman_filter(name, sensor, backend):
    """The UKF's points are drawn once a step: they carry its noise into the next motion."""
    # Two states allow no kappa of -4.
    settings = {"ukf": SigmaPointSettings(kappa=1.0)} if name == "ukf" else {}
    values = measurements(SENSORS[sensor], 200)
    found = of_estimator(name, backend, SENSORS[sensor], values, **settings)
    right = kalman(SENSORS[sensor], values, noise_first=name == "ukf")
    for mine, its in zip(found, right, strict=True):
        np.testing.assert_allclose(mine.mean, its.mean, rtol=1e-9)
        np.testing.assert_allclose(mine.covariance, its.covariance, rtol=1e-9)
        np.testing.assert_allclose(mine.innovations, its.innovations, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("backend", "sensor", "linearisation"),
    pairwise(BACKENDS, SENSORS, ["published", "trajectory"], n=4),
)
def test_the_mhe_ends_where_the_kalman_filter_does_while_its_window_grows(
    backend, sensor, linearisation
):
    """Full information ends at the filter's mean; a window that moves has another arrival."""
    values = measurements(SENSORS[sensor], 31)
    own = HorizonSettings(horizon=30, linearisation=linearisation)
    steps = list(of_estimator("mhe", backend, SENSORS[sensor], values, mhe=own))
    oracle = list(kalman(SENSORS[sensor], values))
    for mine, right in zip(steps[:30], oracle[:30], strict=True):
        np.testing.assert_allclose(mine.mean / UNIT, right.mean / UNIT, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(mine.covariance, right.covariance, rtol=1e-6)
        np.testing.assert_allclose(mine.innovations, right.innovations, rtol=0.0, atol=1e-7)
    assert not np.allclose(steps[30].covariance, oracle[30].covariance, rtol=1e-3)


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_mean_of_the_enkf_over_seeds_is_the_kalman_filters(sensor):
    values, n = measurements(SENSORS[sensor], 20), 200
    enkf = EnsembleSettings(n_members=400)
    *_, found = of_estimator("enkf", "compiled", SENSORS[sensor], values, n, enkf=enkf)
    *_, right = kalman(SENSORS[sensor], values)
    deviation = np.sqrt(np.diag(right.covariance[0]))
    off = (found.covariance - right.covariance) / np.outer(deviation, deviation)
    for errors in ((found.mean - right.mean) / deviation, off.reshape(n, 4)):
        standard_error = errors.std(axis=0) / np.sqrt(n)
        # A mean of M independent draws is off by 1 / sqrt(M) deviations; its bias falls as 1 / M.
        assert (np.abs(errors.mean(axis=0)) < 4.0 * standard_error + 3.0 / 400).all()
        assert (errors.std(axis=0) < 3.0 / np.sqrt(400)).all()
