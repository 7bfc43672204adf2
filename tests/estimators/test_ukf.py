"""Both backends of the unscented Kalman filter, and each against the other."""

from dataclasses import dataclass

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints

from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.compiled.ukf import CompiledUKF
from dptse_env.estimators.compiled.ukf_kernels import factor
from dptse_env.estimators.reference.ukf import ReferenceUKF
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY, RecordLibrary

from .episodes import FIXED_SENSORS, SIGMA, random_streams, simulate

both_backends = pytest.mark.parametrize("ukf", [CompiledUKF, ReferenceUKF])
both_sets = pytest.mark.parametrize("parameters", ["paper", "w99-3lane"])
both_bounds = pytest.mark.parametrize("bounds", ["cone", "box"])


def started(ukf, episodes, **settings):
    n = len(episodes.start)
    filters = ukf(episodes.model, n, EstimatorSettings(**settings))
    filters.reset(episodes.everyone, episodes.start, random_streams(n))
    return filters


def run(filters, episodes, steps, sigma=SIGMA, watch=lambda _: None):
    for k in steps:
        filters.predict(episodes.everyone, episodes.inputs[k])
        filters.update(episodes.everyone, episodes.observed[k], episodes.values[k], sigma)
        watch(k)


def scale_of(model):
    return np.tile([model.density_scale, model.density_scale * model.speed_scale], 19)


# Against the oracle -------------------------------------------------------------------------------


@both_sets
@both_bounds
def test_backends_take_the_same_step_from_every_state_of_an_episode(parameters, bounds):
    """Started anew from one filter's state each step: rounding is not what is compared."""
    episodes = simulate(parameters)
    compiled = started(CompiledUKF, episodes, bounds=bounds)
    reference = started(ReferenceUKF, episodes, bounds=bounds)
    one, scale = reference._filters[0], scale_of(episodes.model)
    # In the box w has no bound: points that break the CFL condition blow up rounding.
    tolerance = {"rtol": 0.0, "atol": 1e-9} if bounds == "cone" else {"rtol": 1e-6, "atol": 1e-6}
    for k in range(700):
        one.x, one.P = compiled.states[0] / scale, compiled.covariances[0]
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        np.testing.assert_allclose(compiled.states / scale, reference.states / scale, **tolerance)
        np.testing.assert_allclose(compiled.covariances, reference.covariances, **tolerance)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, **tolerance)
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)


def test_backends_take_the_same_step_from_every_state_of_a_simulated_episode(tmp_path):
    """Not run freely: the filter amplifies rounding, the reference against itself as well."""
    record = RecordLibrary(tmp_path).get(PAPER_HIGHWAY, 3)
    counts, sums = record.counts, record.speed_sums
    speed = np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
    density = counts / PAPER_HIGHWAY.segment_length
    model = ARZModel(PAPER_HIGHWAY, load_parameters("w99-3lane"))
    filters = [kind(model, 1, EstimatorSettings()) for kind in (CompiledUKF, ReferenceUKF)]
    start = model.states(0.05 * model.jam_density[None], np.full((1, 19), 90.0))
    one, rng, scale = np.arange(1), np.random.default_rng(0), scale_of(model)
    for ukf in filters:
        ukf.reset(one, start, random_streams(1))
    for k in range(1, len(density)):
        before = slice(k - 1, k)
        inputs = model.boundary_inputs(density[before, 19:], speed[before, 19:])
        observed = np.zeros((1, 19), bool)
        observed[0, [*((3 * np.arange(5) + k) % 15), *FIXED_SENSORS]] = True
        values = np.stack([density[k, :19], np.nan_to_num(speed[k, :19], nan=102.0)], -1)
        values = values + SIGMA * rng.normal(size=values.shape)
        a, b = filters
        b._filters[0].x, b._filters[0].P = a.states[0] / scale, a.covariances[0]
        for ukf in filters:
            ukf.predict(one, inputs)
            ukf.update(one, observed, values[None], SIGMA)
            assert not ukf.diverged.any()
        assert np.linalg.eigvalsh(filters[0].covariances[0]).min() >= -1e-10
        np.testing.assert_allclose(a.states / scale, b.states / scale, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(a.covariances, b.covariances, rtol=0.0, atol=1e-9)


def test_weights_are_the_papers():
    ukf = CompiledUKF(ARZModel(PAPER_HIGHWAY, load_parameters("paper")), 1, EstimatorSettings())
    points = ukf._points
    peer = MerweScaledSigmaPoints(38, alpha=0.1, beta=2.0, kappa=-4.0)
    assert peer.Wm[0] == pytest.approx(-110.765, abs=1e-3)
    assert peer.Wc[0] == pytest.approx(-107.775, abs=1e-3)
    assert points.weight == pytest.approx(peer.Wm[1], rel=1e-12)
    assert points.weight == pytest.approx(1.4706, abs=1e-4)
    # Sum d d' of all weights, written around the first point instead of the mean.
    assert points.surplus == pytest.approx(peer.Wc[0] - peer.Wm[0] - 1.0, rel=1e-12)


def test_a_root_is_one_and_what_has_none_is_refused():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(38, 38))
    matrix = np.zeros((38, 40))
    matrix[:, :38] = root @ root.T + np.eye(38)
    upper = matrix.copy()
    assert factor(upper, 38)
    triangle = np.triu(upper[:, :38])
    np.testing.assert_allclose(triangle.T @ triangle, matrix[:, :38], rtol=1e-11, atol=1e-11)
    for bad in (np.nan, -1.0, np.inf):
        broken = matrix.copy()
        broken[20, 20] = bad
        assert not factor(broken, 38)


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


@both_backends
def test_equals_the_textbook_kalman_filter_where_all_is_linear(ukf, monkeypatch):
    """x' = F (x + w), below the density that a measurement takes at least, so v is linear too."""
    monkeypatch.setattr(ukf, "kappa", 1.0)  # two states allow no -4
    v_f, rho_m, tau = 102.0, 333.0, 60.0
    noise, initial = 2e-5, 1e-9
    settings = EstimatorSettings(process_noise=(noise, noise), initial_variance=initial)
    filters = ukf(ARZModel(BlockedCell(), load_parameters("paper")), 1, settings)
    floor, unit = 0.01 * rho_m, np.array([rho_m, rho_m * v_f])
    f = np.array([[1.0, 0.0], [v_f / tau, 1.0 - 1.0 / tau]])
    q = np.diag((noise * unit) ** 2)
    h = np.array([[1.0, 0.0], [0.0, 1.0 / floor]])
    offset = np.array([0.0, -v_f * 0.01**2])
    sigma = np.array([0.2, 6.0])
    x, p = np.array([2.0, 200.0]), np.diag(initial * unit**2)
    everyone, rng = np.arange(1), np.random.default_rng(0)
    filters.reset(everyone, x[None], random_streams(1))
    inputs = np.array([[0.0, v_f, 1.2 * rho_m]])
    for _ in range(300):
        z = np.array([2.0, 2.0 * v_f / floor]) + offset + sigma * rng.normal(size=2)
        filters.predict(everyone, inputs)
        filters.update(everyone, np.ones((1, 1), bool), z[None, None], sigma)
        x, p = f @ x, f @ p @ f.T
        s = h @ p @ h.T + np.diag(sigma**2)
        y = z - h @ x - offset
        np.testing.assert_allclose(filters.innovations[0, 0], y / np.sqrt(np.diag(s)), atol=1e-9)
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ y, p - gain @ s @ gain.T + q  # the noise of the motion to come
        assert 1.0 < x[0] < floor
        np.testing.assert_allclose(filters.states[0], x, rtol=1e-9)
    np.testing.assert_allclose(filters.covariances[0] * np.outer(unit, unit), p, rtol=1e-9)


@both_backends
def test_worthless_measurements_equal_none(ukf):
    episodes = simulate(n_steps=100)
    filters, blind = started(ukf, episodes), started(ukf, episodes)
    run(filters, episodes, range(100), sigma=np.array([1e12, 1e12]))
    for k in range(100):
        blind.predict(episodes.everyone, episodes.inputs[k])
    np.testing.assert_allclose(filters.states, blind.states, rtol=1e-9)


@both_backends
def test_without_noise_worthless_measurements_leave_the_model_alone(ukf):
    episodes = simulate(n_steps=100)
    filters = started(ukf, episodes, process_noise=(1e-9, 1e-9), initial_variance=1e-18)
    run(filters, episodes, range(100), sigma=np.array([1e12, 1e12]))
    states, model = episodes.start, episodes.model
    for k in range(100):
        states = model.project(model.step(states, episodes.inputs[k]))
    np.testing.assert_allclose(filters.states, states, rtol=1e-4)


# Soundness ----------------------------------------------------------------------------------------


@both_sets
@both_bounds
def test_covariance_stays_symmetric_and_definite(parameters, bounds):
    episodes = simulate(parameters, n=2)
    ukf = started(CompiledUKF, episodes, bounds=bounds)

    def check(_):
        covariances = ukf.covariances
        np.testing.assert_array_equal(covariances, covariances.swapaxes(1, 2))
        assert np.linalg.eigvalsh(covariances).min() >= -1e-10
        assert not ukf.diverged.any()

    run(ukf, episodes, range(700), watch=check)


def test_points_drawn_again_after_projection_lose_definiteness(monkeypatch):
    """What filterpy does by itself: points that no longer belong to the mean and P."""
    episodes = simulate(n_steps=60)
    sound, trapped = started(ReferenceUKF, episodes), started(ReferenceUKF, episodes)
    one = trapped._filters[0]
    draw_once = type(one).compute_process_sigmas

    def draw_again(self, *arguments, **named):
        draw_once(self, *arguments, **named)
        self.points_fn.moved = None

    def predict(inputs):
        monkeypatch.setattr(type(one), "compute_process_sigmas", draw_again)
        one.predict(inputs=inputs)
        monkeypatch.setattr(type(one), "compute_process_sigmas", draw_once)
        drawn = episodes.model.project(one.sigmas_f * one.scale, one.bounds)
        one.sigmas_f, one.has_moved = drawn / one.scale, True

    monkeypatch.setattr(one, "move", predict)
    least = {sound: np.inf, trapped: np.inf}
    lost = 0
    for k in range(60):
        for filters, before in least.items():
            run(filters, episodes, [k])
            least[filters] = min(before, np.linalg.eigvalsh(filters.covariances[0]).min())
        lost += trapped.diverged[0]
        assert not sound.diverged.any()
    assert least[sound] > 0.0
    assert lost > 0 or least[trapped] < -1e-10


@both_backends
def test_an_empty_set_of_measurements_changes_nothing(ukf):
    episodes = simulate(n_steps=50)
    filters = started(ukf, episodes)
    run(filters, episodes, range(49))
    filters.predict(episodes.everyone, episodes.inputs[49])
    states, covariances = filters.states, filters.covariances
    nothing = np.zeros((1, 19), bool)
    filters.update(episodes.everyone, nothing, np.full((1, 19, 2), np.nan), SIGMA)
    np.testing.assert_allclose(filters.states, states, rtol=1e-14)
    np.testing.assert_array_equal(filters.covariances, covariances)
    np.testing.assert_array_equal(filters.innovations, 0.0)
    assert not filters.diverged.any()


@both_backends
def test_values_of_unobserved_segments_are_not_looked_at(ukf):
    episodes = simulate(n_steps=30)
    a, b = started(ukf, episodes), started(ukf, episodes)
    hidden = np.where(episodes.observed[..., None], episodes.values, np.nan)
    for k in range(30):
        for filters, values in ((a, episodes.values), (b, hidden)):
            filters.predict(episodes.everyone, episodes.inputs[k])
            filters.update(episodes.everyone, episodes.observed[k], values[k], SIGMA)
    np.testing.assert_array_equal(a.states, b.states)
    np.testing.assert_array_equal(a.innovations, b.innovations)
    np.testing.assert_array_equal(b.innovations[~episodes.observed[29]], 0.0)


@both_sets
@both_bounds
@pytest.mark.parametrize("filling", [0.0, 1.0], ids=["empty", "jam"])
@both_backends
def test_adversarial_starts_and_noise_stay_finite_and_within_bounds(
    ukf, parameters, bounds, filling
):
    steps = 700 if ukf is CompiledUKF else 60
    episodes = simulate(parameters, n=2, n_steps=steps, noise=10.0)
    model = episodes.model
    filters = started(ukf, episodes, bounds=bounds)
    density = np.full((2, 19), filling) * model.jam_density
    filters.reset(episodes.everyone, model.states(density, np.zeros((2, 19))), random_streams(2))

    def check(_):
        states = filters.states
        np.testing.assert_allclose(model.project(states, bounds), states, rtol=1e-12)
        estimate = filters.estimate()
        for field in ("density", "speed", "density_std", "speed_std"):
            assert np.isfinite(getattr(estimate, field)).all()
        assert np.isfinite(filters.innovations).all()

    run(filters, episodes, range(steps), watch=check)


@both_backends
def test_divergence_is_flagged_and_ends_at_the_prior(ukf):
    episodes = simulate(n=3, n_steps=20)
    filters, healthy = started(ukf, episodes), started(ukf, episodes)
    run(filters, episodes, range(10))
    run(healthy, episodes, range(10))
    poisoned = episodes.values[10].copy()
    poisoned[1, 14, 0] = np.nan
    everyone = episodes.everyone
    for each, values in ((filters, poisoned), (healthy, episodes.values[10])):
        each.predict(everyone, episodes.inputs[10])
        each.update(everyone, episodes.observed[10], values, SIGMA)
    assert filters.diverged.tolist() == [False, True, False]
    np.testing.assert_allclose(filters.states[1], episodes.start[1], rtol=1e-12)
    np.testing.assert_array_equal(filters.covariances[1], 1e-3 * np.eye(38))
    np.testing.assert_array_equal(filters.innovations[1], 0.0)
    for i in (0, 2):
        np.testing.assert_array_equal(filters.states[i], healthy.states[i])
    run(filters, episodes, [11])
    assert not filters.diverged.any()


@both_backends
@pytest.mark.parametrize("poison", [np.nan, np.inf, -1.0, "indefinite"])
def test_a_broken_covariance_is_found(ukf, poison):
    episodes = simulate(n_steps=5)
    filters = started(ukf, episodes)
    run(filters, episodes, range(3))
    kept = filters._filters.covariances if ukf is CompiledUKF else filters._filters[0].P[None]
    if poison == "indefinite":
        kept[0, 20, 4] = kept[0, 4, 20] = 10.0
    else:
        kept[0, 20, 20] = poison
    filters.update(episodes.everyone, episodes.observed[4], episodes.values[4], SIGMA)
    assert filters.diverged.tolist() == [True]
    np.testing.assert_array_equal(filters.covariances[0], 1e-3 * np.eye(38))


def test_non_finite_inputs_diverge_instead_of_crashing():
    episodes = simulate(n_steps=2)
    for kind in (CompiledUKF, ReferenceUKF):
        filters = started(kind, episodes)
        filters.predict(episodes.everyone, np.full((1, 9), np.nan))
        filters.update(episodes.everyone, episodes.observed[0], episodes.values[0], SIGMA)
        assert filters.diverged.tolist() == [True]
        assert np.isfinite(filters.states).all()


# Batches ------------------------------------------------------------------------------------------


@both_backends
def test_a_batch_equals_a_loop_to_the_bit(ukf):
    episodes = simulate(n=4, n_steps=60)
    batch = started(ukf, episodes)
    run(batch, episodes, range(60))
    for i in range(4):
        one = ukf(episodes.model, 1, EstimatorSettings())
        alone = np.arange(1)
        one.reset(alone, episodes.start[i : i + 1], random_streams(1))
        for k in range(60):
            one.predict(alone, episodes.inputs[k, i : i + 1])
            row = slice(i, i + 1)
            one.update(alone, episodes.observed[k, row], episodes.values[k, row], SIGMA)
        np.testing.assert_array_equal(one.states[0], batch.states[i])
        np.testing.assert_array_equal(one.covariances[0], batch.covariances[i])
        np.testing.assert_array_equal(one.innovations[0], batch.innovations[i])


@both_backends
def test_only_the_episodes_named_are_touched(ukf):
    episodes = simulate(n=4, n_steps=20)
    filters = started(ukf, episodes)
    run(filters, episodes, range(10))
    states, covariances, innovations = (
        filters.states,
        filters.covariances,
        filters.innovations.copy(),
    )
    some = np.array([3, 1])
    filters.predict(some, episodes.inputs[10, some])
    filters.update(some, episodes.observed[10, some], episodes.values[10, some], SIGMA)
    filters.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    for i in (0, 2):
        np.testing.assert_array_equal(filters.states[i], states[i])
        np.testing.assert_array_equal(filters.covariances[i], covariances[i])
        np.testing.assert_array_equal(filters.innovations[i], innovations[i])
    np.testing.assert_allclose(filters.states[1], episodes.start[1], rtol=1e-12)
    assert not np.array_equal(filters.states[3], states[3])


@both_backends
def test_the_same_episode_gives_the_same_result(ukf):
    episodes = simulate(n_steps=50)
    first, second = started(ukf, episodes), started(ukf, episodes)
    run(first, episodes, range(50))
    np.random.default_rng().normal(size=100)
    run(second, episodes, range(50))
    np.testing.assert_array_equal(first.states, second.states)
    second.reset(episodes.everyone, episodes.start, random_streams(1))
    run(second, episodes, range(50))
    np.testing.assert_array_equal(first.states, second.states)


@both_backends
def test_shapes_are_checked(ukf):
    filters = started(ukf, simulate(n_steps=1))
    everyone = np.arange(1)
    with pytest.raises(ValueError, match=r"states must have shape \(1, 38\), got \(1, 37\)"):
        filters.reset(everyone, np.zeros((1, 37)), random_streams(1))
    with pytest.raises(ValueError, match=r"inputs must have shape \(1, 9\), got \(9,\)"):
        filters.predict(everyone, np.zeros(9))
    with pytest.raises(ValueError, match=r"episodes must be in 0\.\.0, got 1"):
        filters.predict(np.array([1]), np.zeros((1, 9)))
