"""The ensemble Kalman filter: against the Kalman filter where all is linear, and by statistics."""

from dataclasses import dataclass

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.compiled.enkf import CompiledEnKF, streams_of
from dptse_env.model import ARZModel, load_parameters

from .episodes import SIGMA, random_streams, simulate

both_sets = pytest.mark.parametrize("parameters", ["paper", "w99-3lane"])
both_bounds = pytest.mark.parametrize("bounds", ["cone", "box"])


def started(episodes, seed=0, **settings):
    n = len(episodes.start)
    filters = CompiledEnKF(episodes.model, n, EstimatorSettings(**settings))
    filters.reset(episodes.everyone, episodes.start, random_streams(n, seed))
    return filters


def run(filters, episodes, steps, sigma=SIGMA, watch=lambda _: None):
    for k in steps:
        filters.predict(episodes.everyone, episodes.inputs[k])
        filters.update(episodes.everyone, episodes.observed[k], episodes.values[k], sigma)
        watch(k)


# Against the oracle -------------------------------------------------------------------------------


@dataclass(frozen=True)
class BlockedCell:
    """One segment that nobody enters or leaves: its dynamics are linear."""

    n_mainline: int = 1
    on_ramps: tuple[int, ...] = ()
    off_ramps: tuple[int, ...] = ()
    exit_shares: tuple[float, ...] = ()
    segment_length: float = 0.1
    segment_lanes: tuple[int, ...] = (3,)
    lanes: int = 3
    ramp_lanes: int = 1


def linear_errors(n_members, n_seeds, monkeypatch, steps=20):
    """Errors of mean and covariance against the Kalman filter, over its deviations, by seed."""
    monkeypatch.setattr(CompiledEnKF, "n_members", n_members)
    v_f, rho_m, tau, noise, initial = 102.0, 333.0, 60.0, 2e-5, 1e-8
    settings = EstimatorSettings(process_noise=(noise, noise), initial_variance=initial)
    model = ARZModel(BlockedCell(), load_parameters("paper"))
    filters, everyone = CompiledEnKF(model, n_seeds, settings), np.arange(n_seeds)
    floor, unit = 0.01 * rho_m, np.array([rho_m, rho_m * v_f])
    f = np.array([[1.0, 0.0], [v_f / tau, 1.0 - 1.0 / tau]])
    q, h = np.diag((noise * unit) ** 2), np.array([[1.0, 0.0], [0.0, 1.0 / floor]])
    offset, sigma = np.array([0.0, -v_f * 0.01**2]), np.array([0.05, 2.0])
    x, p = np.array([2.0, 160.0]), np.diag(initial * unit**2)
    filters.reset(everyone, np.tile(x, (n_seeds, 1)), random_streams(n_seeds))
    rng, inputs = np.random.default_rng(0), np.tile([0.0, v_f, 1.2 * rho_m], (n_seeds, 1))
    for _ in range(steps):
        z = np.array([2.0, 1.6 * v_f / floor]) + offset + sigma * rng.normal(size=2)
        filters.predict(everyone, inputs)
        values = np.broadcast_to(z, (n_seeds, 1, 2))
        filters.update(everyone, np.ones((n_seeds, 1), bool), values, sigma)
        x, p = f @ x, f @ p @ f.T + q
        s = h @ p @ h.T + np.diag(sigma**2)
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ (z - h @ x - offset), p - gain @ s @ gain.T
    deviation = np.sqrt(np.diag(p))
    covariances = filters.covariances * np.outer(unit, unit)
    return (filters.states - x) / deviation, covariances / np.outer(deviation, deviation) - (
        p / np.outer(deviation, deviation)
    )


def test_approaches_the_kalman_filter_as_one_over_the_root_of_the_members(monkeypatch):
    spreads = {}
    for n_members in (25, 100, 400, 1600):
        mean, covariance = linear_errors(n_members, 200, monkeypatch)
        spreads[n_members] = np.sqrt(np.mean(mean**2)), np.sqrt(np.mean(covariance**2))
    for i in range(2):
        logs = np.log([spread[i] for spread in spreads.values()])
        slope = np.polyfit(np.log(list(spreads)), logs, 1)[0]
        assert slope == pytest.approx(-0.5, abs=0.08)
    # A mean of M independent draws is off by 1 / sqrt(M) deviations; updates correlate them.
    assert spreads[100][0] < 0.2


def test_mean_over_seeds_is_the_kalman_filters(monkeypatch):
    mean, covariance = linear_errors(400, 200, monkeypatch)
    for errors in (mean, covariance.reshape(200, 4)):
        standard_error = errors.std(axis=0) / np.sqrt(len(errors))
        # The bias of a finite ensemble falls as 1 / M.
        assert (np.abs(errors.mean(axis=0)) < 4.0 * standard_error + 3.0 / 400).all()


def test_seeds_differ_by_what_an_ensemble_leaves_open():
    """200 seeds on the same traffic scatter less than each claims not to know."""
    one = simulate(n_steps=40)
    n = 200
    filters = CompiledEnKF(one.model, n, EstimatorSettings())
    everyone = np.arange(n)
    filters.reset(everyone, np.repeat(one.start, n, axis=0), random_streams(n))
    for k in range(40):
        filters.predict(everyone, np.repeat(one.inputs[k], n, axis=0))
        observed, values = (np.repeat(a[k], n, axis=0) for a in (one.observed, one.values))
        filters.update(everyone, observed, values, SIGMA)
    estimate = filters.estimate()
    scatter, claimed = estimate.density.std(axis=0), estimate.density_std.mean(axis=0)
    assert (scatter > 0.02 * claimed).all()
    assert (scatter < claimed).all()


def test_worthless_measurements_equal_none():
    episodes = simulate(n_steps=100)
    filters, blind = started(episodes), started(episodes)
    run(filters, episodes, range(100), sigma=np.array([1e12, 1e12]))
    for k in range(100):
        blind.predict(episodes.everyone, episodes.inputs[k])
    np.testing.assert_allclose(filters.states, blind.states, rtol=1e-6)


def test_without_noise_worthless_measurements_leave_the_model_alone():
    episodes = simulate(n_steps=100)
    filters = started(episodes, process_noise=(0.0, 0.0), initial_variance=1e-18)
    run(filters, episodes, range(100), sigma=np.array([1e12, 1e12]))
    states, model = episodes.start, episodes.model
    for k in range(100):
        states = model.project(model.step(states, episodes.inputs[k]))
    np.testing.assert_allclose(filters.states, states, rtol=1e-4)


def test_an_empty_set_of_measurements_changes_nothing():
    episodes = simulate(n_steps=50)
    filters = started(episodes)
    run(filters, episodes, range(49))
    filters.predict(episodes.everyone, episodes.inputs[49])
    members = filters.members
    nothing = np.zeros((1, 19), bool)
    filters.update(episodes.everyone, nothing, np.full((1, 19, 2), np.nan), SIGMA)
    np.testing.assert_allclose(filters.members, members, rtol=1e-12)
    np.testing.assert_array_equal(filters.innovations, 0.0)
    assert not filters.diverged.any()


def test_values_of_unobserved_segments_are_not_looked_at():
    episodes = simulate(n_steps=30)
    a, b = started(episodes), started(episodes)
    hidden = np.where(episodes.observed[..., None], episodes.values, np.nan)
    for k in range(30):
        for filters, values in ((a, episodes.values), (b, hidden)):
            filters.predict(episodes.everyone, episodes.inputs[k])
            filters.update(episodes.everyone, episodes.observed[k], values[k], SIGMA)
    np.testing.assert_array_equal(a.members, b.members)
    np.testing.assert_array_equal(b.innovations[~episodes.observed[29]], 0.0)


# Soundness ----------------------------------------------------------------------------------------


@both_sets
def test_covariance_is_one_and_no_episode_diverges(parameters):
    episodes = simulate(parameters, n=2)
    filters = started(episodes)

    def check(_):
        covariances = filters.covariances
        np.testing.assert_array_equal(covariances, covariances.swapaxes(1, 2))
        assert np.linalg.eigvalsh(covariances).min() >= -1e-10
        assert not filters.diverged.any()

    run(filters, episodes, range(700), watch=check)


@both_sets
@both_bounds
@pytest.mark.parametrize("filling", [0.0, 1.0], ids=["empty", "jam"])
def test_adversarial_starts_and_noise_stay_finite_and_within_bounds(parameters, bounds, filling):
    episodes = simulate(parameters, n=2, noise=10.0)
    model = episodes.model
    filters = started(episodes, bounds=bounds)
    density = np.full((2, 19), filling) * model.jam_density
    filters.reset(episodes.everyone, model.states(density, np.zeros((2, 19))), random_streams(2))

    def check(_):
        for states in (filters.states, filters.members[0]):
            np.testing.assert_allclose(model.project(states, bounds), states, rtol=1e-9, atol=1e-9)
        estimate = filters.estimate()
        for field in ("density", "speed", "density_std", "speed_std"):
            assert np.isfinite(getattr(estimate, field)).all()
        assert np.isfinite(filters.innovations).all()

    run(filters, episodes, range(700), watch=check)


@pytest.mark.parametrize("poison", ["values", "inputs", "members"])
def test_divergence_is_flagged_and_ends_at_the_prior(poison):
    episodes = simulate(n=3, n_steps=20)
    filters, healthy = started(episodes), started(episodes)
    run(filters, episodes, range(10))
    run(healthy, episodes, range(10))
    values, inputs = episodes.values[10].copy(), episodes.inputs[10].copy()
    if poison == "values":
        values[1, 14, 0] = np.nan
    elif poison == "inputs":
        inputs[1] = np.nan
    else:
        filters._swarms[1, 4, 3] = np.nan
    filters.predict(episodes.everyone, inputs)
    filters.update(episodes.everyone, episodes.observed[10], values, SIGMA)
    run(healthy, episodes, [10])
    assert filters.diverged.tolist() == [False, True, False]
    away = (filters.states[1] - episodes.start[1]) / np.tile([400.0, 400.0 * 140.0], 19)
    assert (np.abs(away) < 5.0 * np.sqrt(1e-3 / 100)).all()
    np.testing.assert_array_equal(filters.innovations[1], 0.0)
    for i in (0, 2):
        np.testing.assert_array_equal(filters.members[i], healthy.members[i])
    run(filters, episodes, [11])
    assert not filters.diverged.any()


# Streams and batches ------------------------------------------------------------------------------


def test_a_batch_equals_a_loop_to_the_bit():
    episodes = simulate(n=4, n_steps=60)
    batch = started(episodes)
    run(batch, episodes, range(60))
    for i in range(4):
        one, alone, row = CompiledEnKF(episodes.model, 1, EstimatorSettings()), np.arange(1), [i]
        one.reset(alone, episodes.start[row], [random_streams(4)[i]])
        for k in range(60):
            one.predict(alone, episodes.inputs[k, row])
            one.update(alone, episodes.observed[k, row], episodes.values[k, row], SIGMA)
        np.testing.assert_array_equal(one.members[0], batch.members[i])
        np.testing.assert_array_equal(one.innovations[0], batch.innovations[i])


def test_only_the_episodes_named_are_touched():
    episodes = simulate(n=4, n_steps=20)
    filters, other = started(episodes), started(episodes)
    for each in (filters, other):
        run(each, episodes, range(10))
    some = np.array([3, 1])
    filters.predict(some, episodes.inputs[10, some])
    filters.update(some, episodes.observed[10, some], episodes.values[10, some], SIGMA)
    filters.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    for i in (0, 2):
        np.testing.assert_array_equal(filters.members[i], other.members[i])
        np.testing.assert_array_equal(filters.innovations[i], other.innovations[i])
    assert not np.array_equal(filters.members[3], other.members[3])
    # Nor were the streams of the others: they go on alike.
    both = np.array([0, 2])
    for each in (filters, other):
        each.predict(both, episodes.inputs[11, both])
    np.testing.assert_array_equal(filters.members[both], other.members[both])


def test_the_seed_decides_and_the_global_generator_is_left_alone():
    episodes = simulate(n_steps=50)
    first, second, third = started(episodes), started(episodes), started(episodes, seed=1)
    np.random.seed(1)  # noqa: NPY002
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    run(first, episodes, range(50))
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    run(second, episodes, range(50))
    run(third, episodes, range(50))
    np.testing.assert_array_equal(first.members, second.members)
    assert not np.array_equal(first.members, third.members)


def test_the_streams_of_an_episode_are_independent():
    a, b = streams_of(np.random.default_rng(0))
    x, y = a.standard_normal(20_000), b.standard_normal(20_000)
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.03
