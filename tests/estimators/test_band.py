"""Covariances that reach a band along the road: EKF and UKF, both backends."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import BACKENDS, DemandSettings, EstimatorSettings, make_estimator
from dptse_env.estimators.localisation import Places, state_places
from dptse_env.estimators.reference.band import DenseBand
from dptse_env.model import ARZModel
from dptse_env.model.network import MeasurementRows
from dptse_env.model.parameters import load_parameters

from ..cases import pairwise
from ..model.roads import STRAIGHT, UNEVEN
from .episodes import (
    REFERENCE_SPEED,
    SIGMAS,
    Episodes,
    assert_same,
    random_streams,
    run,
    show,
    simulate,
)

FILTERS = ("ekf", "ukf")
every_filter = pytest.mark.parametrize("name", FILTERS)
both_backends = pytest.mark.parametrize("backend", BACKENDS)
NOISE = {
    "psi": {},
    "w": {"process_noise_in": "w", "density_growth": 0.02, "count_noise": 0.05},
    "demand": {"demand": DemandSettings(), "density_growth": 0.02},
}


def estimator_of(name, backend, episodes, settings):
    """An estimator at the prior of episodes, with demand states where the settings have them."""
    n, model = len(episodes.start), episodes.model
    made = make_estimator(name, backend, model, n, settings)
    made.reset(episodes.everyone, episodes.start, random_streams(n))
    return made


def assert_agreement(one, other):
    """That the compiled filter and its reference are where the other is, in normalised units."""
    assert not np.any(one.diverged | other.diverged)
    scale, tolerance = one.model.state_scale, {"rtol": 0.0, "atol": 1e-7}
    np.testing.assert_allclose(one.states / scale, other.states / scale, **tolerance)
    np.testing.assert_allclose(one.covariances, other.covariances, **tolerance)
    # Almost empty, an off-ramp's flow and density are almost one number.
    np.testing.assert_allclose(one.innovations, other.innovations, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize(("name", "band", "noise"), pairwise(FILTERS, [1, 5, 9], NOISE))
def test_backends_agree_over_an_episode(name, band, noise):
    release = "flow" if noise == "demand" else "speed"
    episodes = simulate(n=2, n_steps=100, release=release)
    settings = EstimatorSettings(band=band, **NOISE[noise])
    one, other = (
        estimator_of(name, backend, episodes, settings) for backend in ("compiled", "reference")
    )
    for k in range(100):
        if name == "ukf":
            # Its points meet kinks, where rounding errors grow: each step starts from one state.
            for i, reference in enumerate(other._filters):
                reference.x = one.states[i] / one.model.state_scale
                reference.P = one.covariances[i]
        run(one, episodes, [k])
        run(other, episodes, [k])
        assert_agreement(one, other)
    a, b = one.estimate(), other.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-5, atol=1e-5)


@every_filter
def test_a_second_update_in_a_step_agrees(name):
    """And measurements ahead of the first prediction: the UKF makes points for them."""
    episodes, settings = simulate(n_steps=6), EstimatorSettings(band=4)
    one, other = (
        estimator_of(name, which, episodes, settings) for which in ("compiled", "reference")
    )
    for filters in (one, other):
        for k in (0, 1):
            data = episodes.observed[k], episodes.values[k], episodes.sigma
            filters.update(episodes.everyone, *data)
        run(filters, episodes, [2, 3])
        data = episodes.observed[4], episodes.values[4], episodes.sigma
        filters.update(episodes.everyone, *data)
    assert_agreement(one, other)


@every_filter
@both_backends
def test_a_band_that_covers_the_road_is_none(name, backend):
    """The paper's road has 15 segments: the first and the last are 14 apart."""
    episodes = simulate(n_steps=20)
    with_band, without = (
        estimator_of(name, backend, episodes, EstimatorSettings(band=band)) for band in (14, None)
    )
    run(with_band, episodes, range(20))
    run(without, episodes, range(20))
    assert_same(show(with_band), show(without))
    np.testing.assert_array_equal(with_band.covariances, without.covariances)


@every_filter
@both_backends
def test_the_band_follows_positions_along_the_road_not_indices(name, backend):
    """The on-ramp at face 3 is segment 15, far from its neighbours 2 and 3 by index."""
    episodes = simulate(n_steps=30)
    estimator = estimator_of(name, backend, episodes, EstimatorSettings(band=3))
    run(estimator, episodes, range(30))
    covariance, x = estimator.covariances[0], state_places(episodes.model).position
    distance = np.abs(x[:, None] - x)
    np.testing.assert_array_equal(covariance[distance > 3.1], 0.0)
    assert (covariance[distance < 3.1] != 0.0).mean() > 0.95
    assert abs(covariance[30, 4]) > 0.0
    assert covariance[30, 28] == 0.0


def test_what_a_band_costs_falls_with_it():
    """The distance from the filter without a band, over an episode."""
    episodes = simulate(n_steps=200)

    def densities(band):
        estimator, found = (
            estimator_of("ekf", "compiled", episodes, EstimatorSettings(band=band)),
            [],
        )
        run(estimator, episodes, range(200), watch=lambda _: found.append(estimator.states[:, ::2]))
        return np.array(found)

    full = densities(None)
    narrow, wide = (np.sqrt(np.mean((densities(band) - full) ** 2)) for band in (2, 9))
    assert wide < 0.2 * narrow
    assert wide < 0.5  # [veh/km], of a jam density of 400


@every_filter
@both_backends
def test_all_but_the_ends_of_a_road_within_the_band_is_almost_the_filter_without(name, backend):
    """On a plain road, whose places are the numbers of its states."""
    episodes = rows_episodes(spans=(1,) * 8)
    points = {"alpha": 0.1, "beta": 0.01}  # gives the first point no surplus, which has a taper
    nearly, full = (
        estimator_of(name, backend, episodes, EstimatorSettings(band=band, ukf=points))
        for band in (6, None)
    )
    for k in range(4):
        run(nearly, episodes, [k])
        run(full, episodes, [k])
        np.testing.assert_allclose(nearly.states, full.states, rtol=1e-4)
        np.testing.assert_allclose(nearly.covariances, full.covariances, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "backend", "band", "noise"), pairwise(FILTERS, BACKENDS, [1, 4], NOISE)
)
def test_covariances_stay_positive_semidefinite(name, backend, band, noise):
    """Over random traffic with few and many measurements, precise and worthless ones."""
    n_steps = 300 if backend == "compiled" else 40
    episodes = simulate("paper", n_steps=n_steps, seed=3, noise=3.0)
    rng = np.random.default_rng(0)
    estimator = estimator_of(name, backend, episodes, EstimatorSettings(band=band, **NOISE[noise]))
    for k in range(n_steps):
        estimator.predict(episodes.everyone, episodes.inputs[k])
        observed = rng.random((1, 19)) < rng.choice([0.0, 0.1, 0.5, 1.0])
        sigma = episodes.sigma * 10.0 ** rng.uniform(-3.0, 2.0, (1, 19, 1))
        estimator.update(episodes.everyone, observed, episodes.values[k], sigma)
        assert not estimator.diverged.any()
        covariance = estimator.covariances[0]
        scale = np.sqrt(np.diag(covariance))
        assert scale.min() > 0.0
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > -1e-9
        assert np.isfinite(estimator.estimate().speed_std).all()


def test_a_covariance_cut_to_a_band_stays_one_with_its_variances():
    """Left out without more ado, what lies beyond a band would leave an indefinite matrix."""
    x = np.arange(30.0)
    long_waves = np.cos(0.05 * (x[:, None] - x)) + 1e-6 * np.eye(30)
    near = np.abs(x[:, None] - x) <= 4.0
    assert np.linalg.eigvalsh(np.where(near, long_waves, 0.0)).min() < -0.1
    cut = DenseBand(Places(np.arange(30), x), 4).confine(long_waves)
    assert np.linalg.eigvalsh(cut).min() > 0.0
    np.testing.assert_array_equal(cut[~near], 0.0)
    np.testing.assert_allclose(np.diag(cut), np.diag(long_waves), rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "backend", "poison"),
    pairwise(FILTERS, BACKENDS, [np.nan, np.inf, -np.inf], rest=False),
)
def test_what_is_no_number_diverges_that_episode_only(name, backend, poison):
    episodes = simulate(n=3, n_steps=12)
    settings = EstimatorSettings(band=4)
    estimator, healthy = (estimator_of(name, backend, episodes, settings) for _ in range(2))
    prior = show(estimator)
    for one in (estimator, healthy):
        run(one, episodes, range(8))
    values = episodes.values[8].copy()
    values[1, 14, 1] = poison
    estimator.predict(episodes.everyone, episodes.inputs[8])
    estimator.update(episodes.everyone, episodes.observed[8], values, episodes.sigma)
    run(healthy, episodes, [8])
    found = show(estimator)
    assert found.diverged.tolist() == [False, True, False]
    np.testing.assert_array_equal(found.innovations[1], 0.0)
    np.testing.assert_allclose(found.states[1], prior.states[1])
    np.testing.assert_allclose(estimator.covariances[1], 1e-3 * np.eye(38))
    assert_same(found, show(healthy), [0, 2], [0, 2])


@every_filter
@pytest.mark.parametrize("poison", [np.nan, np.inf, -1.0])
def test_a_broken_covariance_is_found(name, poison):
    episodes = simulate(n_steps=5)
    estimator = estimator_of(name, "compiled", episodes, EstimatorSettings(band=4))
    run(estimator, episodes, range(3))
    estimator._filters.covariances[0, 20, -1] = poison
    estimator.predict(episodes.everyone, episodes.inputs[3])
    estimator.update(episodes.everyone, episodes.observed[4], episodes.values[4], episodes.sigma)
    assert estimator.diverged.tolist() == [True]
    np.testing.assert_array_equal(estimator.covariances[0], 1e-3 * np.eye(38))


def rows_episodes(spans=(1, 3, 2, 1, 8)):
    """Flows over some of a plain road's eight segments, those of a row from its number on."""
    first = np.minimum(np.arange(len(spans)), 8 - np.array(spans))
    rows = MeasurementRows(first, np.array(spans), n_segments=8)
    return disturbed(replace(STRAIGHT, n_mainline=8), rows)


def disturbed(road, rows=None):
    """Sixty steps of flows on a road, with noise in the state and the measurements."""
    model = ARZModel(road, load_parameters("w99-3lane"), reference_speed=REFERENCE_SPEED, rows=rows)
    rng, n_steps, s = np.random.default_rng(0), 60, model.n_segments
    density = 0.1 * model.jam_density * (1.0 + 0.25 * rng.normal(size=(1, s)))
    start = model.states(density, np.full((1, s), 60.0))
    ends = model.n_boundaries
    along = np.full((1, ends), 40.0), np.full((1, ends), 60.0)
    inputs = np.tile(model.boundary_inputs(*along), (n_steps, 1, 1))
    truth, state = np.empty((n_steps, 1, 2 * s)), start
    for k in range(n_steps):
        disturbance = 1.0 + 0.01 * rng.normal(size=2 * s)
        state = model.project(model.step(state, inputs[k]) * disturbance, "cone")
        truth[k] = state
    sigma = SIGMAS["flow"]
    values = np.stack([model.measure(x) for x in truth])
    values += sigma * rng.normal(size=values.shape)
    observed = rng.random(values.shape[:3]) < 0.6
    return Episodes(model, start, inputs, observed, values, truth, sigma)


@every_filter
@pytest.mark.parametrize("band", [1, 2, 5])
def test_segments_and_ramps_of_any_length_agree(name, band):
    """A band counts segments; all segments of a ramp lie at its face."""
    episodes = disturbed(UNEVEN)
    settings = EstimatorSettings(band=band, ukf={"alpha": 1.0})
    one, other = (
        estimator_of(name, backend, episodes, settings) for backend in ("compiled", "reference")
    )
    for k in range(60):
        run(one, episodes, [k])
        run(other, episodes, [k])
        assert_agreement(one, other)
    covariance, x = one.covariances[0], state_places(episodes.model).position
    distance = np.abs(x[:, None] - x)
    np.testing.assert_array_equal(covariance[distance > band + 0.1], 0.0)
    assert abs(covariance[2 * UNEVEN.on_ramp_segments[1][0], 2 * 3]) > 0.0


@every_filter
@pytest.mark.parametrize("band", [1, 3])
def test_rows_over_several_segments_agree(name, band):
    """Also a row that is longer than the band reaches."""
    episodes = rows_episodes()
    # On so short a road the default spread of points, and the weights it leads to, are extreme.
    settings = EstimatorSettings(band=band, ukf={"alpha": 1.0})
    one, other = (
        estimator_of(name, backend, episodes, settings) for backend in ("compiled", "reference")
    )
    for k in range(60):
        run(one, episodes, [k])
        run(other, episodes, [k])
        assert_agreement(one, other)
    errors = one.states - episodes.truth[-1]
    assert np.sqrt(np.mean(errors[:, ::2] ** 2)) < 15.0


@every_filter
def test_one_episode_of_a_batch_equals_it_alone(name):
    episodes, settings = simulate(n=3, n_steps=40), EstimatorSettings(band=4)
    batch = estimator_of(name, "compiled", episodes, settings)
    run(batch, episodes, range(40))
    part = replace(
        episodes,
        start=episodes.start[[1]],
        **{name: getattr(episodes, name)[:, [1]] for name in ("inputs", "observed", "values")},
    )
    alone = estimator_of(name, "compiled", part, settings)
    run(alone, part, range(40))
    assert_same(show(alone), show(batch), [0], [1])
