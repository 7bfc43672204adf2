"""The ensemble Kalman filter's options, members and draws."""

from dptse_env.estimators import Measurement
import numpy as np
import pytest

from dptse_env.estimators import EnsembleSettings, EstimatorSettings, make_estimator
from tests.cases import pairwise

from .episodes import SIGMA, random_streams, run, simulate
from .episodes import started as started_as

both_backends = pytest.mark.parametrize("backend", ["compiled", "reference"])
both_bounds = pytest.mark.parametrize("bounds", ["cone", "box"])


def started(episodes, backend="compiled", **settings):
    return started_as("enkf", backend, episodes, EstimatorSettings(**settings))


# Options ------------------------------------------------------------------------------------------


@both_backends
def test_inflation_widens_what_the_members_claim(backend):
    episodes = simulate(n_steps=30)
    plain = started(episodes, backend=backend)
    wide = started(episodes, backend=backend, enkf=EnsembleSettings(inflation=1.2))
    for filters in (plain, wide):
        run(filters, episodes, range(30))
    ratio = wide.estimate().density_std / plain.estimate().density_std
    assert np.median(ratio) > 1.1


def test_inflation_waits_for_measurements_and_keeps_members_within_bounds():
    episodes = simulate(n_steps=20)
    model = episodes.model
    plain, wide = (
        started(episodes, enkf=EnsembleSettings(inflation=factor)) for factor in (1.0, 3.0)
    )
    nothing = np.zeros((1, 19), bool)
    for k in range(10):
        for filters in (plain, wide):
            filters.predict(episodes.everyone, episodes.inputs[k])
            filters.update(episodes.everyone, Measurement.of(filters.model, nothing, episodes.values[k], SIGMA))
    np.testing.assert_array_equal(plain.members, wide.members)
    run(wide, episodes, range(10, 20))
    members = wide.members[0]
    np.testing.assert_allclose(model.project(members), members, rtol=1e-9)


def test_inflation_alone_scales_distances_from_the_mean():
    """With worthless measurements and room to the bounds nothing else moves the members."""
    episodes = simulate(n_steps=1)
    filters = started(
        episodes, initial_variance=1e-8, bounds="box", enkf=EnsembleSettings(inflation=1.5)
    )
    before, covariances = filters.states, filters.covariances
    filters.update(episodes.everyone, Measurement.of(filters.model, episodes.observed[0], episodes.values[0], 1e12 * SIGMA))
    np.testing.assert_allclose(filters.states, before, rtol=1e-9)
    np.testing.assert_allclose(filters.covariances, 1.5**2 * covariances, rtol=1e-6)


@both_backends
def test_a_taper_keeps_measurements_from_acting_far_away(backend):
    episodes = simulate(n_steps=20)
    filters = started(episodes, backend=backend, enkf=EnsembleSettings(taper=0.25))
    run(filters, episodes, range(19))
    filters.predict(episodes.everyone, episodes.inputs[19])
    before = filters.members.copy()
    only = np.arange(19)[None] == 5
    filters.update(episodes.everyone, Measurement.of(filters.model, only, episodes.values[19], SIGMA))
    moved = np.abs(filters.members - before).max(axis=(0, 1)).reshape(19, 2).max(axis=1) > 1e-6
    # Segments of 0.1 km; face 6, where the first off-ramp leaves, is half of one away.
    near = [3, 4, 5, 6, 7, 17]
    assert np.flatnonzero(moved).tolist() == near


def test_a_taper_beyond_the_road_changes_little():
    episodes = simulate(n_steps=20)
    plain, wide = started(episodes), started(episodes, enkf=EnsembleSettings(taper=1e6))
    for filters in (plain, wide):
        run(filters, episodes, range(20))
    np.testing.assert_allclose(plain.members, wide.members, rtol=1e-6)


# Soundness ----------------------------------------------------------------------------------------


@both_backends
@pytest.mark.parametrize("measured", [True, False])
def test_a_member_that_is_not_finite_is_found_and_its_episode_drawn_anew(backend, measured):
    episodes = simulate(n=3, n_steps=12)
    filters, healthy = (started(episodes, backend=backend) for _ in range(2))
    for each in (filters, healthy):
        run(each, episodes, range(10))
        each.predict(episodes.everyone, episodes.inputs[10])
    if backend == "compiled":
        filters._ensembles.members[1, 4, 3] = np.nan
    else:
        filters.members[1, 3, 4] = np.nan
    observed = episodes.observed[10] & measured
    for each in (filters, healthy):
        each.update(episodes.everyone, Measurement.of(each.model, observed, episodes.values[10], SIGMA))
    assert filters.diverged.tolist() == [False, True, False]
    np.testing.assert_array_equal(filters.innovations[1], 0.0)
    np.testing.assert_allclose(filters.members[1].mean(axis=0), episodes.start[1], rtol=0.3)
    np.testing.assert_array_equal(filters.members[[0, 2]], healthy.members[[0, 2]])
    run(filters, episodes, [11])
    assert not filters.diverged.any()


@pytest.mark.parametrize(
    ("backend", "bounds", "bad"),
    pairwise(["compiled", "reference"], ["cone", "box"], [np.nan, np.inf, -np.inf], rest=False),
)
def test_a_measurement_that_is_not_finite_is_not_projected_away(backend, bounds, bad):
    episodes = simulate(n_steps=1)
    filters = started(episodes, backend=backend, bounds=bounds)
    filters.predict(episodes.everyone, episodes.inputs[0])
    values = episodes.values[0].copy()
    values[0, 14, 0] = bad
    filters.update(episodes.everyone, Measurement.of(filters.model, np.arange(19)[None] == 14, values, SIGMA))
    assert filters.diverged.all()
    np.testing.assert_array_equal(filters.innovations, 0.0)


@both_backends
def test_outputs_that_are_known_exactly_and_twice_over_diverge(backend):
    """Without noise more outputs than members leave no definite S: flagged, not solved."""
    episodes = simulate(n_steps=1)
    filters = started(episodes, backend=backend, enkf=EnsembleSettings(n_members=4))
    filters.predict(episodes.everyone, episodes.inputs[0])
    everything = np.ones((1, 19), bool)
    filters.update(episodes.everyone, Measurement.of(filters.model, everything, episodes.values[0], np.zeros(2)))
    assert filters.diverged.all()
    assert np.isfinite(filters.members).all()


# Streams ------------------------------------------------------------------------------------------


def test_seeds_differ_by_what_an_ensemble_leaves_open():
    """200 seeds on the same traffic scatter less than each claims not to know."""
    one = simulate(n_steps=40)
    n = 200
    filters = make_estimator("enkf", "compiled", one.model, n)
    everyone = np.arange(n)
    filters.reset(everyone, np.repeat(one.start, n, axis=0), random_streams(n))
    for k in range(40):
        filters.predict(everyone, np.repeat(one.inputs[k], n, axis=0))
        observed, values = (np.repeat(a[k], n, axis=0) for a in (one.observed, one.values))
        filters.update(everyone, Measurement.of(filters.model, observed, values, SIGMA))
    estimate = filters.estimate()
    scatter, claimed = estimate.density.std(axis=0), estimate.density_std.mean(axis=0)
    assert (scatter > 0.02 * claimed).all()
    assert (scatter < claimed).all()


@both_backends
def test_what_is_measured_does_not_change_how_members_are_disturbed(backend):
    episodes = simulate(n_steps=12)
    seeing, blind = (started(episodes, backend=backend) for _ in range(2))
    nothing = np.zeros((1, 19), bool)
    for k in range(11):
        for filters, observed in ((seeing, episodes.observed[k]), (blind, nothing)):
            filters.predict(episodes.everyone, episodes.inputs[k])
            filters.update(episodes.everyone, Measurement.of(filters.model, observed, episodes.values[k], SIGMA))
    assert not np.array_equal(seeing.members, blind.members)
    for filters in (seeing, blind):  # from the same members
        if backend == "compiled":
            filters._ensembles.members[:] = episodes.start[:, :, None]
        else:
            filters.members[:] = episodes.start[:, None]
        filters.predict(episodes.everyone, episodes.inputs[11])
    np.testing.assert_array_equal(seeing.members, blind.members)
