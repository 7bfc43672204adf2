"""On linear and Gaussian problems every filter equals the Kalman filter."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    EstimatorSettings,
    HorizonSettings,
    SigmaPointSettings,
    make_estimator,
)
from dptse_env.model import ARZModel, load_parameters
from tests.helpers import Road, pairwise

from .episodes import random_streams, tell

# One segment that nobody enters or leaves has linear dynamics.
V_F, RHO_M, TAU, V_0 = 102.0, 333.0, 60.0, 51.0
FLOOR, UNIT = 0.01 * RHO_M, np.array([RHO_M, RHO_M * V_F])
F = np.array([[1.0, 0.0], [V_F / TAU, 1.0 - 1.0 / TAU]])
NOISE, INITIAL, START = 2e-5, 1e-9, np.array([2.0, 200.0])
Q = np.diag((NOISE * UNIT) ** 2)
EVERYONE, INPUTS = np.arange(1), np.array([[0.0, V_F, 1.2 * RHO_M]])


class Sensor(NamedTuple):
    """A model whose measurement is H x + offset, and the deviations of its noise."""

    model: ARZModel
    H: np.ndarray
    offset: np.ndarray
    sigma: np.ndarray


PAPER = load_parameters("paper")
# Long segments, for the CFL condition; a pressure of (2 / 333)^10 is none.
NO_PRESSURE = replace(PAPER, name="no pressure", gamma=10.0)
SENSORS = {
    # Below the density that a measurement takes at least, the speed is linear in psi.
    "speed": Sensor(
        ARZModel(Road(n_mainline=1), PAPER),
        np.array([[1.0, 0.0], [0.0, 1.0 / FLOOR]]),
        np.array([0.0, -V_F * 0.01**2]),
        np.array([0.4, 6.0]),
    ),
    "flow": Sensor(
        ARZModel(Road(n_mainline=1, segment_length=1.0), NO_PRESSURE, reference_speed=V_0),
        np.array([[1.0, 0.0], [-V_0, 1.0]]),
        np.zeros(2),
        np.array([0.4, 40.0]),
    ),
}


class Step(NamedTuple):
    mean: np.ndarray
    covariance: np.ndarray
    innovations: np.ndarray


def measurements(sensor, n_steps):
    """Values `(K, 1, 1, 2)` around the steady state."""
    noise = sensor.sigma * np.random.default_rng(0).normal(size=(n_steps, 2))
    steady = np.array([2.0, 2.0 * V_F])
    return (sensor.H @ steady + sensor.offset + noise)[:, None, None]


def textbook(sensor, values, noise_first):
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
        yield Step(x, p + before, residual / np.sqrt(np.diag(s)))


def of_estimator(name, backend, sensor, values, **settings):
    noise = {"process_noise": (NOISE, NOISE), "initial_variance": INITIAL}
    given = EstimatorSettings(**noise, **settings)
    estimator = make_estimator(name, backend, sensor.model, 1, given)
    estimator.reset(EVERYONE, START[None], random_streams(1))
    for z in values:
        estimator.predict(EVERYONE, INPUTS)
        tell(estimator, EVERYONE, np.ones((1, 1), bool), z, sensor.sigma)
        covariance = estimator.covariances[0] * np.outer(UNIT, UNIT)
        yield Step(estimator.states[0], covariance, estimator.innovations[0, 0].copy())


@pytest.mark.parametrize(
    ("name", "sensor", "backend"), pairwise(["ekf", "ukf"], SENSORS, BACKENDS, n=4)
)
def test_ekf_and_ukf_are_the_kalman_filter(name, sensor, backend):
    """The UKF's points are drawn once a step: they carry its noise into the next motion."""
    sensor, settings = SENSORS[sensor], {}
    if name == "ukf":
        settings = {"ukf": SigmaPointSettings(kappa=1.0)}  # two states allow no -4
    values = measurements(sensor, 300)
    pairs = zip(
        of_estimator(name, backend, sensor, values, **settings),
        textbook(sensor, values, noise_first=name == "ukf"),
        strict=True,
    )
    for mine, right in pairs:
        np.testing.assert_allclose(mine.mean, right.mean, rtol=1e-9)
        np.testing.assert_allclose(mine.covariance, right.covariance, rtol=1e-9)
        np.testing.assert_allclose(mine.innovations, right.innovations, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("backend", "sensor", "linearisation"),
    pairwise(BACKENDS, SENSORS, ["paper", "trajectory"], n=4),
)
def test_the_mhe_ends_where_the_kalman_filter_does_while_its_window_grows(
    backend, sensor, linearisation
):
    """Full information ends at the filter's mean; a window that moves has another arrival."""
    sensor = SENSORS[sensor]
    values = measurements(sensor, 41)
    own = HorizonSettings(horizon=40, linearisation=linearisation)
    steps = list(of_estimator("mhe", backend, sensor, values, mhe=own))
    oracle = list(textbook(sensor, values, noise_first=False))
    for mine, right in zip(steps[:40], oracle[:40], strict=True):
        np.testing.assert_allclose(mine.mean / UNIT, right.mean / UNIT, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(mine.covariance, right.covariance, rtol=1e-6)
        np.testing.assert_allclose(mine.innovations, right.innovations, rtol=0.0, atol=1e-7)
    assert not np.allclose(steps[40].covariance, oracle[40].covariance, rtol=1e-3)
