import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings, make_estimator
from dptse_env.model.network import MeasurementRows
from tests.cases import pairwise

from . import episodes as shared
from .episodes import REFERENCE_SPEED, RELEASES, run, simulate
from .rows import averaged, update, with_rows

SETTINGS = EstimatorSettings(walk_noise=(0.03, 0.02), initial_variance=2e-3)
BOTH = np.array([333.0, 102.0])  # units of density and speed, the paper's
LARGEST = np.array([333.0, 1.1 * 102.0])


def started(episodes, settings=SETTINGS, start=None):
    return shared.started("random_walk", "compiled", episodes, settings, start)


def speed_of(value, sigma, density):
    """The speed, and its deviation, that a flow gives at a density [veh/km]."""
    density = max(density, 3.33)
    return REFERENCE_SPEED + value / density, sigma / density


@pytest.mark.parametrize("release", RELEASES)
def test_is_a_scalar_kalman_filter_per_segment_and_quantity(release):
    episodes = simulate("paper", n_steps=60, release=release)
    walk, segment = started(episodes), 14
    estimate = walk.estimate()
    mean = np.array([estimate.density[0, segment], estimate.speed[0, segment]])
    variance = 2e-3 * BOTH**2
    for k in range(60):
        run(walk, episodes, [k])
        variance = variance + (np.array([0.03, 0.02]) * BOTH) ** 2
        for i in range(2):
            value, sigma = episodes.values[k, 0, segment, i], episodes.sigma[i]
            if (release, i) == ("flow", 1):
                value, sigma = speed_of(value, sigma, mean[0])
            total = variance[i] + sigma**2
            residual = value - mean[i]
            np.testing.assert_allclose(walk.innovations[0, segment, i], residual / np.sqrt(total))
            mean[i] = np.clip(mean[i] + variance[i] / total * residual, 0.0, LARGEST[i])
            variance[i] *= sigma**2 / total
        estimate = walk.estimate()
        np.testing.assert_allclose(estimate.density[0, segment], mean[0])
        np.testing.assert_allclose(estimate.speed[0, segment], mean[1])
        np.testing.assert_allclose(estimate.density_std[0, segment], np.sqrt(variance[0]))
        np.testing.assert_allclose(estimate.speed_std[0, segment], np.sqrt(variance[1]))


def test_unobserved_segments_lose_certainty():
    episodes = simulate(n_steps=1)
    walk = started(episodes)
    before = walk.estimate()
    walk.predict(episodes.everyone, episodes.inputs[0])
    after = walk.estimate()
    assert (after.density_std > before.density_std).all()
    assert (after.speed_std > before.speed_std).all()


def test_a_flow_of_a_segment_found_empty_is_read_at_the_least_density():
    """Its noise over a density of zero would be infinite, and the flow itself over it, too."""
    episodes = simulate("paper", n_steps=1, release="flow")
    empty = episodes.model.states(np.zeros((1, 19)), np.full((1, 19), 60.0))
    walk = started(episodes, EstimatorSettings(), empty)
    prior = walk.estimate()
    assert (prior.density == 0.0).all()
    values = np.tile([-500.0, 20.0], (1, 19, 1))  # the density stays at zero
    walk.update(
        episodes.everyone,
        Measurement.of(walk.model, np.ones((1, 19), bool), values, episodes.sigma),
    )
    estimate = walk.estimate()
    np.testing.assert_array_equal(estimate.density, 0.0)
    floor = 0.01 * episodes.model.jam_density
    variance, noise = 1e-3 * 102.0**2, (episodes.sigma[1] / floor) ** 2
    said = REFERENCE_SPEED + 20.0 / floor
    expected = prior.speed[0] + variance / (variance + noise) * (said - prior.speed[0])
    np.testing.assert_allclose(estimate.speed[0], expected)
    np.testing.assert_allclose(estimate.speed_std[0] ** 2, variance * noise / (variance + noise))
    # An empty segment's flow tells next to nothing of a speed.
    assert (estimate.speed_std > 0.9 * prior.speed_std).all()


@pytest.mark.parametrize("release", RELEASES)
def test_noiseless_measurements_of_a_certain_state_are_no_division_by_zero(release):
    episodes = simulate(n_steps=1, release=release)
    still = EstimatorSettings(walk_noise=(0.0, 0.0))
    walk = started(episodes, still)
    everywhere = np.ones((1, 19), bool)
    for _ in range(2):
        walk.predict(episodes.everyone, episodes.inputs[0])
        walk.update(
            episodes.everyone,
            Measurement.of(walk.model, everywhere, np.full((1, 19, 2), 20.0), np.zeros(2)),
        )
    np.testing.assert_allclose(walk.estimate().density, 20.0)
    speed = 20.0 if release == "speed" else REFERENCE_SPEED + 20.0 / 20.0
    np.testing.assert_allclose(walk.estimate().speed, speed)
    assert not walk.diverged.any()


@pytest.mark.parametrize(
    ("release", "bad", "which"),
    pairwise(RELEASES, [np.nan, np.inf, -np.inf], [0, 1], rest=False),
)
def test_no_infinity_is_clipped_into_bounds(release, bad, which):
    """Neither by a walk that knows its state for certain, whose gain is zero."""
    episodes = simulate(n=2, n_steps=2, release=release)
    still = EstimatorSettings(walk_noise=(0.0, 0.0))
    for settings, exact in ((SETTINGS, False), (still, True)):
        walk = started(episodes, settings)
        prior = walk.estimate()
        seen = np.ones((2, 19), bool)
        if exact:
            values = np.full((2, 19, 2), 20.0)
            walk.update(episodes.everyone, Measurement.of(walk.model, seen, values, np.zeros(2)))
        values = episodes.values[1].copy()
        values[1, 14, which] = bad
        walk.update(episodes.everyone, Measurement.of(walk.model, seen, values, episodes.sigma))
        assert walk.diverged.tolist() == [False, True]
        estimate = walk.estimate()
        for field in ("density", "speed", "density_std", "speed_std"):
            np.testing.assert_array_equal(getattr(estimate, field)[1], getattr(prior, field)[1])
        np.testing.assert_array_equal(walk.innovations[1], 0.0)


@pytest.mark.parametrize("release", RELEASES)
def test_a_row_of_one_segment_is_read_alike_wherever_it_stands(release):
    """Rows that are the segments in another order take the other path of the code."""
    plain = simulate(n_steps=40, release=release)
    n = plain.model.n_segments
    order = np.random.default_rng(3).permutation(n)
    turned = with_rows(plain.model, MeasurementRows(order, np.ones(n, dtype=np.int64), n))
    assert not turned.rows.are_single
    walk = started(plain)
    other = make_estimator("random_walk", "compiled", turned, 1, SETTINGS)
    other.reset(plain.everyone, plain.start, shared.random_streams(1))
    for k in range(40):
        for each, at in ((walk, np.arange(n)), (other, order)):
            each.predict(plain.everyone, plain.inputs[k])
            values, observed = plain.values[k][:, at], plain.observed[k][:, at]
            each.update(plain.everyone, Measurement.of(each.model, observed, values, plain.sigma))
        np.testing.assert_allclose(other.means, walk.means, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.variances, walk.variances, rtol=1e-9)
        np.testing.assert_allclose(other.innovations, walk.innovations[:, order], atol=1e-9)


def test_rows_of_several_segments_are_kalman_updates_without_covariances():
    episodes = averaged(12)
    rows = episodes.model.rows
    assert rows.span.max() == 3
    walk = started(episodes)
    n = episodes.model.n_segments
    largest = np.stack([episodes.model.jam_density, np.full(n, LARGEST[1])], axis=1)
    for k in range(12):
        walk.predict(episodes.everyone, episodes.inputs[k])
        means, variances = walk.means[0].copy(), walk.variances[0].copy()
        for m in np.flatnonzero(episodes.observed[k, 0]):
            H, centre = rows.weights[m].copy(), episodes.centre[k, 0]
            for i in range(2):
                if i == 1:
                    H *= np.maximum(means[:, 0], 0.01 * episodes.model.jam_density)
                noise = episodes.sigma[k, 0, m, i] ** 2
                P = np.diag(variances[:, i])
                total = H @ P @ H + noise
                value = episodes.values[k, 0, m, i] + (H @ centre if i == 1 else 0.0)
                residual = value - H @ means[:, i]
                gain = P @ H / total
                means[:, i] = np.clip(means[:, i] + gain * residual, 0.0, largest[:, i])
                variances[:, i] = np.diag(P - np.outer(gain, H @ P))
        update(walk, episodes, k)
        np.testing.assert_allclose(walk.means[0], means, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(walk.variances[0], variances, rtol=1e-7)


def test_a_sum_that_is_not_finite_resets_the_episode():
    episodes = averaged(2)
    walk = started(episodes)
    values = episodes.values[0].copy()
    values[0, -1, 1] = np.nan
    args = episodes.sigma[0], episodes.centre[0]
    walk.update(
        episodes.everyone,
        Measurement.of(walk.model, np.ones_like(episodes.observed[0]), values, *args),
    )
    assert walk.diverged[0]
    np.testing.assert_array_equal(walk.means, walk._prior)
    assert np.all(walk.innovations == 0.0)
