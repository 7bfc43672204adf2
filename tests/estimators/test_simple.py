"""The random walk, its blend with an EKF, and the traffic model alone."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import BlendSettings, DemandSettings, EstimatorSettings
from dptse_env.model.network import MeasurementRows
from tests.helpers import pairwise

from .episodes import RELEASES, assert_same, run, show, simulate, tell
from .episodes import started as started_as
from .rows import averaged, update, with_rows

FIELDS = ("density", "speed", "density_std", "speed_std")
WALK = EstimatorSettings(walk_noise=(0.03, 0.02), initial_variance=2e-3)
BLEND = EstimatorSettings(process_noise=(0.01, 0.02), noise_scale=(1.3, 0.8))
BOTH = np.array([333.0, 102.0])  # units of density and speed, the paper's

both_releases = pytest.mark.parametrize("release", RELEASES)


def started(name, episodes, settings=None, start=None):
    return started_as(name, "compiled", episodes, settings, start)


def weighted(density, speed, base=BLEND):
    return replace(base, blend=BlendSettings(density_weight=density, speed_weight=speed))


# The random walk ----------------------------------------------------------------------------------


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
                H, value = self.model.rows.weights[m].copy(), values[m, i]
                if i == 1 and self.model.reference_speed is not None:
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


@pytest.mark.parametrize("kind", [*RELEASES, "rows"])
def test_a_walk_is_a_kalman_filter_without_covariances(kind):
    if kind == "rows":
        episodes = averaged(12)
    else:
        episodes = simulate("paper", n_steps=40, noise=3.0, release=kind)
    model = episodes.model
    walk, textbook = started("random_walk", episodes, WALK), TextbookWalk(model, episodes.start)
    for k in range(len(episodes.inputs)):
        centre = np.full(model.n_segments, 0.0 if kind == "speed" else model.reference_speed)
        if kind == "rows":
            walk.predict(episodes.everyone, episodes.inputs[k])
            update(walk, episodes, k)
            sigma, centre = episodes.sigma[k, 0], episodes.centre[k, 0]
        else:
            run(walk, episodes, [k])
            sigma = np.broadcast_to(episodes.sigma, episodes.values[k, 0].shape)
        found = textbook.step(episodes.observed[k, 0], episodes.values[k, 0], sigma, centre)
        close = {"rtol": 1e-7, "atol": 1e-9}
        np.testing.assert_allclose(walk.means[0], textbook.means, **close)
        np.testing.assert_allclose(walk.variances[0], textbook.variances, **close)
        np.testing.assert_allclose(walk.innovations[0], found, **close)
    shown = walk.estimate()
    np.testing.assert_array_equal(np.stack([shown.density, shown.speed], axis=-1), walk.means)
    deviations = np.stack([shown.density_std, shown.speed_std], axis=-1)
    np.testing.assert_allclose(deviations**2, walk.variances)


def test_a_flow_of_a_segment_found_empty_is_read_at_the_least_density():
    """Its noise over a density of zero would be infinite, and the flow itself over it, too."""
    episodes = simulate("paper", n_steps=1, release="flow")
    empty = episodes.model.states(np.zeros((1, 19)), np.full((1, 19), 60.0))
    walk = started("random_walk", episodes, start=empty)
    prior = walk.estimate()
    assert (prior.density == 0.0).all()
    values = np.tile([-500.0, 20.0], (1, 19, 1))  # the density stays at zero
    tell(walk, episodes.everyone, np.ones((1, 19), bool), values, episodes.sigma)
    estimate = walk.estimate()
    np.testing.assert_array_equal(estimate.density, 0.0)
    # An empty segment's flow tells next to nothing of a speed.
    assert np.isfinite(estimate.speed).all()
    assert (estimate.speed_std > 0.9 * prior.speed_std).all()


@both_releases
def test_noiseless_measurements_of_a_certain_state_are_no_division_by_zero(release):
    episodes = simulate(n_steps=1, release=release)
    walk = started("random_walk", episodes, EstimatorSettings(walk_noise=(0.0, 0.0)))
    everywhere = np.ones((1, 19), bool)
    for _ in range(2):
        walk.predict(episodes.everyone, episodes.inputs[0])
        tell(walk, episodes.everyone, everywhere, np.full((1, 19, 2), 20.0), np.zeros(2))
    np.testing.assert_allclose(walk.estimate().density, 20.0)
    speed = 20.0 if release == "speed" else episodes.model.reference_speed + 20.0 / 20.0
    np.testing.assert_allclose(walk.estimate().speed, speed)
    np.testing.assert_array_equal(walk.innovations, 0.0)
    assert not walk.diverged.any()


@pytest.mark.parametrize(
    ("release", "bad", "which"),
    pairwise(RELEASES, [np.nan, np.inf, -np.inf], [0, 1], rest=False),
)
def test_no_infinity_is_clipped_into_bounds(release, bad, which):
    """Neither by a walk that knows its state for certain, whose gain is zero."""
    episodes = simulate(n=2, n_steps=2, release=release)
    for exact in (False, True):
        settings = EstimatorSettings(walk_noise=(0.0, 0.0)) if exact else WALK
        walk = started("random_walk", episodes, settings)
        prior, seen = walk.estimate(), np.ones((2, 19), bool)
        if exact:
            tell(walk, episodes.everyone, seen, np.full((2, 19, 2), 20.0), np.zeros(2))
        values = episodes.values[1].copy()
        values[1, 14, which] = bad
        tell(walk, episodes.everyone, seen, values, episodes.sigma)
        assert walk.diverged.tolist() == [False, True]
        estimate = walk.estimate()
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(estimate, field)[1], getattr(prior, field)[1])
        np.testing.assert_array_equal(walk.innovations[1], 0.0)


def test_covariances_of_a_walk_give_its_variances_back():
    episodes = simulate(n_steps=5)
    walk, model = started("random_walk", episodes), episodes.model
    run(walk, episodes, range(5))
    jacobian = model.traffic_jacobian(walk.states)[0] * model.state_scale[:2]
    joint = walk.covariances[0].reshape(19, 2, 19, 2)
    for s in range(19):
        block = jacobian[s] @ joint[s, :, s] @ jacobian[s].T
        np.testing.assert_allclose(block, np.diag(walk.variances[0, s]), rtol=1e-9, atol=1e-9)
        joint[s, :, s] = 0.0
    assert not joint.any()


def test_rows_of_one_segment_may_stand_in_any_order():
    plain = simulate(n_steps=20, release="flow")
    order = np.random.default_rng(3).permutation(19)
    rows = MeasurementRows(order, np.ones(19, dtype=np.int64), 19)
    turned = replace(
        plain,
        model=with_rows(plain.model, rows),
        observed=plain.observed[..., order],
        values=plain.values[..., order, :],
    )
    walk, other = (started("random_walk", episodes, WALK) for episodes in (plain, turned))
    run(walk, plain, range(20))
    run(other, turned, range(20))
    np.testing.assert_array_equal(other.means, walk.means)
    np.testing.assert_array_equal(other.innovations, walk.innovations[:, order])


# The blend ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [*RELEASES, "rows"])
def test_a_blend_is_the_weighted_mean_of_both_filters_on_the_same_measurements(kind):
    episodes = averaged(12) if kind == "rows" else simulate(n=2, n_steps=12, release=kind)
    settings = weighted(0.7, 0.2, replace(BLEND, speed_cap=0.9))
    blend = started("blend", episodes, settings)
    parts = [started(name, episodes, settings) for name in ("ekf", "random_walk")]
    for k in range(12):
        for each in (blend, *parts):
            if kind == "rows":
                each.predict(episodes.everyone, episodes.inputs[k])
                update(each, episodes, k)
            else:
                run(each, episodes, [k])
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


@pytest.mark.parametrize(
    ("weight", "name", "demand"),
    [(1.0, "ekf", None), (1.0, "ekf", DemandSettings()), (0.0, "random_walk", None)],
)
def test_at_either_end_a_blend_is_one_of_its_parts(weight, name, demand):
    episodes, base = simulate(n_steps=10), replace(BLEND, demand=demand)
    blend = started("blend", episodes, weighted(weight, weight, base))
    alone = started(name, episodes, base)
    for each in (blend, alone):
        run(each, episodes, range(10))
    found, expected = show(blend), show(alone)
    assert_same(found._replace(states=expected.states), expected)
    assert blend.states.shape == (1, 38 if demand is None else 41)


def test_a_copy_of_a_blend_goes_on_alone():
    """As `QueryProcess.fork` makes it; the kernels write to arrays that several objects share."""
    episodes = simulate(n=2, n_steps=12)
    blend = started("blend", episodes)
    run(blend, episodes, range(5))
    before, fork = show(blend), copy.deepcopy(blend, {id(blend.model): blend.model})
    run(fork, episodes, range(5, 12))
    assert_same(show(blend), before)
    run(blend, episodes, range(5, 12))
    assert_same(show(blend), show(fork))


def test_both_parts_of_a_blend_are_reset_where_one_diverges():
    """No input means nothing to a walk, which goes back to the prior all the same."""
    episodes = simulate(n=2, n_steps=6)
    blend = started("blend", episodes)
    prior = show(blend)
    run(blend, episodes, range(5))
    poisoned = episodes.inputs[5].copy()
    poisoned[1] = np.nan
    blend.predict(episodes.everyone, poisoned)
    tell(blend, episodes.everyone, episodes.observed[5], episodes.values[5], episodes.sigma)
    assert blend.diverged.tolist() == [False, True]
    estimate = blend.estimate()
    for field in FIELDS:
        np.testing.assert_allclose(getattr(estimate, field)[1], getattr(prior, field)[1])


# The model alone ----------------------------------------------------------------------------------


def test_the_open_loop_is_the_model_alone_whatever_is_measured():
    speeds, flows = (simulate(n=2, n_steps=100, release=release) for release in RELEASES)
    one, other = (started("open_loop", episodes) for episodes in (speeds, flows))
    model, states = speeds.model, speeds.model.project(speeds.start)
    for k in range(100):
        run(one, speeds, [k])
        run(other, flows, [k])
        states = model.project(model.step(states, speeds.inputs[k]))
    for each in (one, other):
        estimate = each.estimate()
        np.testing.assert_array_equal(each.states, states)
        np.testing.assert_array_equal(estimate.density, model.density(states))
        np.testing.assert_array_equal(estimate.speed, model.speed(states))
        for nothing in (estimate.density_std, estimate.speed_std, each.innovations):
            np.testing.assert_array_equal(nothing, 0.0)
