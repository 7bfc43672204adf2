"""The random walk, its blend with an EKF, and the traffic model alone."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import BlendSettings, DemandSettings, EstimatorSettings

from .helpers import FIELDS, RELEASES, run, simulate, started, step

WALK = EstimatorSettings(walk_noise=(0.03, 0.02), initial_variance=2e-3)

every_release = pytest.mark.parametrize("release", RELEASES)


class TextbookWalk:
    """A Kalman filter of each quantity, after each number of which covariances are dropped."""

    def __init__(self, model, start):
        self.model, self.upper = model, np.full((model.n_segments, 2), 1.1 * model.speed_scale)
        self.upper[:, 0] = model.jam_density
        traffic = np.stack([model.density(start)[0], model.speed(start)[0]], axis=1)
        self.unit = np.array([model.density_scale, model.speed_scale])
        self.means = np.clip(traffic, 0.0, self.upper)
        self.variances = np.tile(2e-3 * self.unit**2, (model.n_segments, 1))

    def step(self, observed, values, sigma, centre):
        """Return the innovations of a step."""
        self.variances += (np.array(WALK.walk_noise) * self.unit) ** 2
        innovations = np.zeros(values.shape)
        for m in np.flatnonzero(observed):
            for i in range(2):
                H, value = self.model.averaging[m].copy(), values[m, i]
                if i == 1 and self.model.centre is not None:
                    H *= np.maximum(self.means[:, 0], 0.01 * self.model.jam_density)
                    value += H @ centre
                P, residual = np.diag(self.variances[:, i]), value - H @ self.means[:, i]
                total = H @ P @ H + sigma[m, i] ** 2
                gain = P @ H / total
                innovations[m, i] = residual / np.sqrt(total)
                moved = self.means[:, i] + gain * residual
                self.means[:, i] = np.clip(moved, 0.0, self.upper[:, i])
                self.variances[:, i] = np.diag(P - np.outer(gain, H @ P))
        return innovations


@every_release
def test_a_walk_is_a_kalman_filter_without_covariances(release):
    episodes = simulate("published", n_steps=40, noise=3.0, release=release)
    model, close = episodes.model, {"rtol": 1e-7, "atol": 1e-9}
    walk = started("random_walk", "compiled", episodes, WALK)
    textbook, default = TextbookWalk(model, episodes.start), np.full((40, 1, 19), 51.0)
    centre = default if episodes.centre is None else episodes.centre
    for k in range(40):
        step(walk, episodes, k)
        given = (array[k, 0] for array in (episodes.observed, episodes.values, episodes.sigma))
        found = textbook.step(*given, centre[k, 0])
        np.testing.assert_allclose(walk.means[0], textbook.means, **close)
        np.testing.assert_allclose(walk.variances[0], textbook.variances, **close)
        np.testing.assert_allclose(walk.innovations[0], found, **close)
    shown = walk.estimate()
    np.testing.assert_array_equal(np.stack([shown.density, shown.speed], axis=-1), walk.means)
    deviations = np.stack([shown.density_std, shown.speed_std], axis=-1)
    np.testing.assert_allclose(deviations**2, walk.variances)


@pytest.mark.parametrize("release", ["speed", "flow"])
def test_a_walk_that_is_certain_divides_by_no_zero(release):
    episodes = simulate(n_steps=2, release=release)
    walk = started("random_walk", "compiled", episodes, EstimatorSettings(walk_noise=(0.0, 0.0)))
    values = np.full((1, 19, 2), 20.0)
    run(walk, episodes, range(2), observed=np.ones((1, 19), bool), values=values, sigma=np.zeros(2))
    found = walk.estimate()
    speed = 20.0 if release == "speed" else episodes.model.centre + 20.0 / 20.0
    np.testing.assert_allclose(found.density, 20.0)
    np.testing.assert_allclose(found.speed, speed)
    np.testing.assert_array_equal(walk.innovations, 0.0)
    assert not walk.diverged.any()


@every_release
@pytest.mark.parametrize("weights", [(0.7, 0.2), (1.0, 0.0)])
def test_a_blend_is_the_weighted_mean_of_both_filters_on_the_same_measurements(release, weights):
    episodes = simulate(n=2, n_steps=12, release=release)
    settings = EstimatorSettings(
        process_noise=(0.01, 0.02), noise_scale=(1.3, 0.8), speed_cap=0.9, demand=DemandSettings(),
        blend=BlendSettings(density_weight=weights[0], speed_weight=weights[1]),
    )  # fmt: skip
    blend, ekf = (started(name, "compiled", episodes, settings) for name in ("blend", "ekf"))
    walk = started("random_walk", "compiled", episodes, replace(settings, demand=None))
    for k in range(12):
        for each in (blend, ekf, walk):
            step(each, episodes, k)
        for field in FIELDS:
            found, one, other = (getattr(each.estimate(), field) for each in (blend, ekf, walk))
            c = weights[0] if field.startswith("density") else weights[1]
            np.testing.assert_allclose(found, c * one + (1.0 - c) * other, rtol=1e-12)
            assert np.abs(one - other).max() > 0.0
        c = np.array(weights)
        innovations = c * ekf.innovations + (1.0 - c) * walk.innovations
        np.testing.assert_allclose(blend.innovations, innovations, rtol=1e-12)
    np.testing.assert_array_equal(blend.states, ekf.states)
    np.testing.assert_array_equal(blend.covariances, ekf.covariances)
    assert blend.states.shape == (2, 41)
    assert not np.any(blend.diverged | blend.fallback)


@every_release
def test_the_open_loop_is_the_model_alone_whatever_is_measured(release):
    episodes = simulate(n=2, n_steps=50, release=release)
    alone, model = started("open_loop", "compiled", episodes), episodes.model
    states = model.project(episodes.start)
    for k in range(50):
        step(alone, episodes, k)
        states = model.project(model.step(states, episodes.inputs[k]))
    estimate = alone.estimate()
    np.testing.assert_array_equal(alone.states, states)
    np.testing.assert_array_equal(estimate.density, model.density(states))
    np.testing.assert_array_equal(estimate.speed, model.speed(states))
    for nothing in (estimate.density_std, estimate.speed_std, alone.innovations):
        np.testing.assert_array_equal(nothing, 0.0)
