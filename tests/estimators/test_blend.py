"""The blend of an EKF and a random walk."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    BlendSettings,
    DemandSettings,
    EstimatorSettings,
    Measurement,
)

from .episodes import RELEASES, assert_same, run, show, simulate, started
from .rows import averaged, update

FIELDS = ("density", "speed", "density_std", "speed_std")
BASE = EstimatorSettings(process_noise=(0.01, 0.02), noise_scale=(1.3, 0.8))

both_backends = pytest.mark.parametrize("backend", BACKENDS)


def weighted(density, speed, base=BASE):
    return replace(base, blend=BlendSettings(density_weight=density, speed_weight=speed))


@both_backends
@pytest.mark.parametrize("release", RELEASES)
def test_is_the_weighted_mean_of_both_filters_on_the_same_measurements(backend, release):
    episodes = simulate(n=2, n_steps=20, release=release)
    settings = weighted(0.7, 0.2, replace(BASE, demand=None, speed_cap=0.9))
    blend = started("blend", backend, episodes, settings)
    parts = [started(name, backend, episodes, settings) for name in ("ekf", "random_walk")]
    for k in range(20):
        for one in (blend, *parts):
            run(one, episodes, [k])
        estimate, (ekf, walk) = blend.estimate(), [part.estimate() for part in parts]
        for field in FIELDS:
            c = 0.7 if field.startswith("density") else 0.2
            expected = c * getattr(ekf, field) + (1.0 - c) * getattr(walk, field)
            np.testing.assert_allclose(getattr(estimate, field), expected, rtol=1e-12)
            assert np.abs(getattr(ekf, field) - getattr(walk, field)).max() > 0.0
        c = np.array([0.7, 0.2])
        innovations = c * parts[0].innovations + (1.0 - c) * parts[1].innovations
        np.testing.assert_allclose(blend.innovations, innovations, rtol=1e-12)
    np.testing.assert_array_equal(blend.states, parts[0].states)
    np.testing.assert_array_equal(blend.covariances, parts[0].covariances)
    assert not np.any(blend.diverged | blend.fallback)


@both_backends
@pytest.mark.parametrize(("weight", "name"), [(1.0, "ekf"), (0.0, "random_walk")])
def test_at_either_end_it_is_one_of_its_parts(backend, weight, name):
    episodes = simulate(n_steps=10)
    blend = started("blend", backend, episodes, weighted(weight, weight))
    alone = started(name, backend, episodes, BASE)
    for one in (blend, alone):
        run(one, episodes, range(10))
    found, expected = show(blend), show(alone)
    assert_same(found._replace(states=expected.states), expected)


@both_backends
def test_its_filter_may_have_demand_states(backend):
    episodes = simulate(n_steps=5)
    settings = weighted(1.0, 1.0, replace(BASE, demand=DemandSettings()))
    blend, ekf = (started(name, backend, episodes, settings) for name in ("blend", "ekf"))
    for one in (blend, ekf):
        run(one, episodes, range(5))
    assert blend.states.shape == (1, 38 + 3)
    assert_same(show(blend), show(ekf))


@both_backends
def test_a_copy_goes_on_alone(backend):
    """As `QueryProcess.fork` makes it; the kernels write to arrays that several objects share."""
    episodes = simulate(n=2, n_steps=12)
    blend = started("blend", backend, episodes)
    run(blend, episodes, range(5))
    before, fork = show(blend), copy.deepcopy(blend, {id(blend.model): blend.model})
    run(fork, episodes, range(5, 12))
    assert_same(show(blend), before)
    run(blend, episodes, range(5, 12))
    assert_same(show(blend), show(fork))


@both_backends
def test_both_parts_are_reset_where_one_diverges(backend):
    """No input means nothing to a walk, which goes back to the prior all the same."""
    episodes = simulate(n=2, n_steps=6)
    blend = started("blend", backend, episodes)
    prior = show(blend)
    run(blend, episodes, range(5))
    poisoned = episodes.inputs[5].copy()
    poisoned[1] = np.nan
    blend.predict(episodes.everyone, poisoned)
    blend.update(
        episodes.everyone,
        Measurement.of(blend.model, episodes.observed[5], episodes.values[5], episodes.sigma),
    )
    assert blend.diverged.tolist() == [False, True]
    estimate = blend.estimate()
    for field in FIELDS:
        np.testing.assert_allclose(getattr(estimate, field)[1], getattr(prior, field)[1])


@both_backends
def test_both_parts_read_rows_of_several_segments(backend):
    episodes = averaged(12)
    settings = weighted(0.7, 0.2)
    blend, ekf, walk = filters = [
        started(name, backend, episodes, settings) for name in ("blend", "ekf", "random_walk")
    ]
    for k in range(12):
        for one in filters:
            one.predict(episodes.everyone, episodes.inputs[k])
            update(one, episodes, k)
    expected = 0.7 * ekf.estimate().density + 0.3 * walk.estimate().density
    np.testing.assert_allclose(blend.estimate().density, expected, rtol=1e-12)
    c = np.array([0.7, 0.2])
    innovations = c * ekf.innovations + (1.0 - c) * walk.innovations
    np.testing.assert_allclose(blend.innovations, innovations, rtol=1e-12)
