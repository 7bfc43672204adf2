"""The ensemble Kalman filter against the Kalman filter where all is linear, by statistics."""

from dptse_env.estimators import Measurement
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from filterpy.kalman import EnsembleKalmanFilter

from dptse_env.estimators import EnsembleSettings, EstimatorSettings
from dptse_env.estimators.enkf import EnKF
from dptse_env.estimators.reference.enkf import ReferenceEnKF
from dptse_env.model import ARZModel, load_parameters
from tests.model.roads import Road

from .episodes import random_streams

both_backends = pytest.mark.parametrize("backend", [EnKF, ReferenceEnKF])


def linear_system(n_steps=20):
    """A cell that nobody enters or leaves, before a jam: x = F x + w, z = H x + offset + v."""
    v_f, rho_m, tau, noise, initial = 102.0, 333.0, 60.0, 2e-5, 1e-8
    floor, unit = 0.01 * rho_m, np.array([rho_m, rho_m * v_f])
    offset, sigma = np.array([0.0, -v_f * 0.01**2]), np.array([0.05, 2.0])
    disturbance = sigma * np.random.default_rng(0).normal(size=(n_steps, 2))
    return SimpleNamespace(
        settings=EstimatorSettings(process_noise=(noise, noise), initial_variance=initial),
        f=np.array([[1.0, 0.0], [v_f / tau, 1.0 - 1.0 / tau]]),
        h=np.array([[1.0, 0.0], [0.0, 1.0 / floor]]),
        q=np.diag((noise * unit) ** 2),
        x=np.array([2.0, 160.0]),
        p=np.diag(initial * unit**2),
        z=np.array([2.0, 1.6 * v_f / floor]) + offset + disturbance,
        offset=offset,
        sigma=sigma,
        unit=unit,
        inputs=np.array([0.0, v_f, 1.2 * rho_m]),
    )


def run_linear(system, backend, n_members, n_seeds):
    settings = replace(system.settings, enkf=EnsembleSettings(n_members=n_members))
    model = ARZModel(Road(n_mainline=1), load_parameters("paper"))
    filters, everyone = backend(model, n_seeds, settings), np.arange(n_seeds)
    filters.reset(everyone, np.tile(system.x, (n_seeds, 1)), random_streams(n_seeds))
    for z in system.z:
        filters.predict(everyone, np.tile(system.inputs, (n_seeds, 1)))
        values = np.broadcast_to(z, (n_seeds, 1, 2))
        filters.update(everyone, Measurement.of(filters.model, np.ones((n_seeds, 1), bool), values, system.sigma))
    return filters


def linear_errors(backend, n_members, n_seeds):
    """Errors of mean and covariance against the Kalman filter, over its deviations, by seed."""
    system = linear_system()
    filters = run_linear(system, backend, n_members, n_seeds)
    f, h, x, p = system.f, system.h, system.x, system.p
    for z in system.z:
        x, p = f @ x, f @ p @ f.T + system.q
        s = h @ p @ h.T + np.diag(system.sigma**2)
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ (z - h @ x - system.offset), p - gain @ s @ gain.T
    deviation = np.sqrt(np.diag(p))
    covariances = filters.covariances * np.outer(system.unit, system.unit)
    return (filters.states - x) / deviation, (covariances - p) / np.outer(deviation, deviation)


@pytest.mark.slow
@both_backends
def test_approaches_the_kalman_filter_as_one_over_the_root_of_the_members(backend):
    spreads = {}
    for n_members in (25, 100, 400):
        mean, covariance = linear_errors(backend, n_members, 200)
        spreads[n_members] = np.sqrt(np.mean(mean**2)), np.sqrt(np.mean(covariance**2))
    for i in range(2):
        logs = np.log([spread[i] for spread in spreads.values()])
        slope = np.polyfit(np.log(list(spreads)), logs, 1)[0]
        assert slope == pytest.approx(-0.5, abs=0.08)
    # A mean of M independent draws is off by 1 / sqrt(M) deviations; updates correlate them.
    assert spreads[100][0] < 0.2


@both_backends
def test_mean_over_seeds_is_the_kalman_filters(backend):
    mean, covariance = linear_errors(backend, 400, 200)
    for errors in (mean, covariance.reshape(200, 4)):
        standard_error = errors.std(axis=0) / np.sqrt(len(errors))
        # The bias of a finite ensemble falls as 1 / M.
        assert (np.abs(errors.mean(axis=0)) < 4.0 * standard_error + 3.0 / 400).all()


def test_means_are_spread_over_seeds_as_filterpys_where_all_is_linear():
    system, n_members, n_seeds = linear_system(8), 50, 150
    ours = run_linear(system, EnKF, n_members, n_seeds).states
    theirs = np.empty_like(ours)
    np.random.seed(0)  # noqa: NPY002, filterpy's draws
    for seed in range(n_seeds):
        plain = EnsembleKalmanFilter(
            system.x, system.p, 2, 1.0, n_members,
            lambda x: system.h @ x + system.offset, lambda x, _: system.f @ x,
        )  # fmt: skip
        plain.Q, plain.R = system.q, np.diag(system.sigma**2)
        for z in system.z:
            plain.predict()
            plain.update(z)
        theirs[seed] = plain.x
    error = np.sqrt((ours.var(axis=0) + theirs.var(axis=0)) / n_seeds)
    assert (np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) < 4.0 * error).all()
    # The logarithm of a ratio of two deviations is off by 1 / sqrt(150), about.
    assert (np.abs(np.log(ours.std(axis=0) / theirs.std(axis=0))) < 0.33).all()
