import numpy as np

from dptse_env.estimators import EstimatorSettings, make_estimator

from .episodes import SIGMA, random_streams, simulate

SETTINGS = EstimatorSettings(walk_noise=(0.03, 0.02), initial_variance=2e-3)


def started(episodes):
    walk = make_estimator("random_walk", "compiled", episodes.model, len(episodes.start), SETTINGS)
    walk.reset(episodes.everyone, episodes.start, random_streams(len(episodes.start)))
    return walk


def test_is_a_scalar_kalman_filter_per_segment_and_quantity():
    episodes = simulate("paper", n_steps=60)
    walk, segment = started(episodes), 14
    scale = np.array([333.0, 102.0])
    mean = np.array([walk.estimate().density[0, segment], walk.estimate().speed[0, segment]])
    variance = 2e-3 * scale**2
    for k in range(60):
        walk.predict(episodes.everyone, episodes.inputs[k])
        walk.update(episodes.everyone, episodes.observed[k], episodes.values[k], SIGMA)
        variance = variance + (np.array([0.03, 0.02]) * scale) ** 2
        total = variance + SIGMA**2
        residual = episodes.values[k, 0, segment] - mean
        np.testing.assert_allclose(walk.innovations[0, segment], residual / np.sqrt(total))
        mean = np.clip(mean + variance / total * residual, 0.0, [333.0, 112.2])
        variance = variance * SIGMA**2 / total
        estimate = walk.estimate()
        np.testing.assert_allclose(estimate.density[0, segment], mean[0])
        np.testing.assert_allclose(estimate.speed[0, segment], mean[1])
        np.testing.assert_allclose(estimate.density_std[0, segment], np.sqrt(variance[0]))
        np.testing.assert_allclose(estimate.speed_std[0, segment], np.sqrt(variance[1]))


def test_unobserved_segments_keep_their_mean_and_lose_certainty():
    episodes = simulate(n_steps=1)
    walk = started(episodes)
    before = walk.estimate()
    walk.predict(episodes.everyone, episodes.inputs[0])
    nothing = np.zeros((1, 19), bool)
    walk.update(episodes.everyone, nothing, np.full((1, 19, 2), np.nan), SIGMA)
    after = walk.estimate()
    np.testing.assert_array_equal(after.density, before.density)
    assert (after.density_std > before.density_std).all()
    np.testing.assert_array_equal(walk.innovations, 0.0)


def test_only_the_episodes_named_are_touched_and_a_batch_equals_a_loop():
    episodes = simulate(n=3, n_steps=20)
    batch, parts = started(episodes), started(episodes)
    for k in range(20):
        batch.predict(episodes.everyone, episodes.inputs[k])
        batch.update(episodes.everyone, episodes.observed[k], episodes.values[k], SIGMA)
        for i in range(3):
            one = np.array([i])
            parts.predict(one, episodes.inputs[k, one])
            parts.update(one, episodes.observed[k, one], episodes.values[k, one], SIGMA)
    np.testing.assert_array_equal(batch.means, parts.means)
    np.testing.assert_array_equal(batch.variances, parts.variances)
    np.testing.assert_array_equal(batch.innovations, parts.innovations)


def test_noise_of_ten_times_the_size_stays_within_bounds():
    episodes = simulate("paper", n=2, n_steps=200, noise=10.0)
    walk = started(episodes)
    for k in range(200):
        walk.predict(episodes.everyone, episodes.inputs[k])
        walk.update(episodes.everyone, episodes.observed[k], episodes.values[k], SIGMA)
        estimate = walk.estimate()
        assert (estimate.density >= 0.0).all()
        assert (estimate.density <= episodes.model.jam_density).all()
        assert ((estimate.speed >= 0.0) & (estimate.speed <= 1.1 * 102.0 + 1e-9)).all()


def test_noiseless_measurements_of_a_certain_state_are_no_division_by_zero():
    episodes = simulate(n_steps=1)
    still = EstimatorSettings(walk_noise=(0.0, 0.0))
    walk = make_estimator("random_walk", "reference", episodes.model, 1, still)
    walk.reset(episodes.everyone, episodes.start, random_streams(1))
    everywhere = np.ones((1, 19), bool)
    for _ in range(2):
        walk.predict(episodes.everyone, episodes.inputs[0])
        walk.update(episodes.everyone, everywhere, np.full((1, 19, 2), 20.0), np.zeros(2))
    np.testing.assert_allclose(walk.estimate().density, 20.0)
    assert not walk.diverged.any()


def test_divergence_is_flagged_and_ends_at_the_prior():
    episodes = simulate(n=2, n_steps=2)
    walk = started(episodes)
    prior = walk.estimate()
    values = episodes.values[0].copy()
    values[1, 14, 1] = np.nan
    walk.predict(episodes.everyone, episodes.inputs[0])
    walk.update(episodes.everyone, episodes.observed[0], values, SIGMA)
    assert walk.diverged.tolist() == [False, True]
    np.testing.assert_array_equal(walk.estimate().speed[1], prior.speed[1])
    np.testing.assert_array_equal(walk.innovations[1], 0.0)
