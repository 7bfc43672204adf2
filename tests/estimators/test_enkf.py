"""The ensemble Kalman filter: against the Kalman filter where all is linear, and by statistics."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from filterpy.kalman import EnsembleKalmanFilter

from dptse_env.estimators import EnsembleSettings, EstimatorSettings
from dptse_env.estimators.compiled.enkf import CompiledEnKF
from dptse_env.estimators.compiled.normals import bits_for, fill
from dptse_env.estimators.reference.enkf import ReferenceEnKF
from dptse_env.model import ARZModel, load_parameters

from .episodes import SIGMA, random_streams, simulate

both_sets = pytest.mark.parametrize("parameters", ["paper", "w99-3lane"])
both_backends = pytest.mark.parametrize("backend", [CompiledEnKF, ReferenceEnKF])
both_bounds = pytest.mark.parametrize("bounds", ["cone", "box"])

FIELDS = ("density", "speed", "density_std", "speed_std")


def started(episodes, seed=0, backend=CompiledEnKF, **settings):
    n = len(episodes.start)
    filters = backend(episodes.model, n, EstimatorSettings(**settings))
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


def linear_system(n_steps=20):
    """The blocked cell between an empty road and a jam: x = F x + w, z = H x + offset + v."""
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
    model = ARZModel(BlockedCell(), load_parameters("paper"))
    filters, everyone = backend(model, n_seeds, settings), np.arange(n_seeds)
    filters.reset(everyone, np.tile(system.x, (n_seeds, 1)), random_streams(n_seeds))
    for z in system.z:
        filters.predict(everyone, np.tile(system.inputs, (n_seeds, 1)))
        values = np.broadcast_to(z, (n_seeds, 1, 2))
        filters.update(everyone, np.ones((n_seeds, 1), bool), values, system.sigma)
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
    ours = run_linear(system, CompiledEnKF, n_members, n_seeds).states
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


# Backends -----------------------------------------------------------------------------------------


class Replay:
    """Draws what a compiled stream is about to draw, a member a row."""

    def __init__(self, stream):
        self.stream = stream.copy()

    def standard_normal(self, shape):
        out = np.empty(shape[0] * shape[1], dtype=np.float32)
        fill(self.stream, out, bits_for(out.size))
        return out.reshape(shape[1], shape[0]).T.astype(float)


@both_sets
@both_bounds
@pytest.mark.parametrize(
    "options",
    [{}, {"inflation": 1.1}, {"taper": 0.35}, {"inflation": 1.1, "taper": 0.35, "n_members": 30}],
    ids=str,
)
def test_given_the_same_draws_backends_agree(parameters, bounds, options):
    episodes = simulate(parameters, n_steps=60)
    settings = {"bounds": bounds, "enkf": EnsembleSettings(**options)}
    compiled = started(episodes, **settings)
    reference = started(episodes, backend=ReferenceEnKF, **settings)
    reference.members[:] = compiled.members
    process, measurement = (Replay(stream) for stream in compiled._ensembles.streams[0])
    reference._streams[0] = SimpleNamespace(process=process, measurement=measurement)
    unit = np.tile([1.0, compiled.model.speed_scale], 19) * compiled.model.density_scale

    for k in range(60):
        for filters in (compiled, reference):
            run(filters, episodes, [k])
        np.testing.assert_allclose(compiled.members / unit, reference.members / unit, atol=1e-9)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-6)
        np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
        a, b = compiled.estimate(), reference.estimate()
        for field in FIELDS:
            np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)
        if bounds == "box":  # leaves psi / rho without a bound, and there rounding grows
            reference.members[:] = compiled.members


def test_backends_are_equal_in_distribution():
    """Estimates and what they claim, over 200 seeds each on the same traffic."""
    one, n = simulate(n_steps=10), 200
    everyone, drawn = np.arange(n), {}
    for backend in (CompiledEnKF, ReferenceEnKF):
        filters = backend(one.model, n, EstimatorSettings())
        filters.reset(everyone, np.repeat(one.start, n, axis=0), random_streams(n))
        drawn[backend] = []
        for k in range(10):
            filters.predict(everyone, np.repeat(one.inputs[k], n, axis=0))
            observed, values = (np.repeat(a[k], n, axis=0) for a in (one.observed, one.values))
            filters.update(everyone, observed, values, SIGMA)
            if k in (0, 4, 9):
                estimate = filters.estimate()
                drawn[backend].append([getattr(estimate, field) for field in FIELDS])
    a, b = (np.array(drawn[backend]) for backend in drawn)
    error = np.sqrt((a.var(axis=2, ddof=1) + b.var(axis=2, ddof=1)) / n)
    scores = (a.mean(axis=2) - b.mean(axis=2)) / error
    assert np.abs(scores).max() < 4.5
    assert np.sqrt(np.mean(scores**2)) < 1.3
    ratios = a.var(axis=2) / b.var(axis=2)  # each off by sqrt(2 / 200), about
    assert abs(np.log(ratios).mean()) < 0.1
    assert np.abs(np.log(ratios)).max() < 0.8


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
            filters.update(episodes.everyone, nothing, episodes.values[k], SIGMA)
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
    filters.update(episodes.everyone, episodes.observed[0], episodes.values[0], 1e12 * SIGMA)
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
    filters.update(episodes.everyone, only, episodes.values[19], SIGMA)
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
    if backend is CompiledEnKF:
        filters._ensembles.swarms[1, 4, 3] = np.nan
    else:
        filters.members[1, 3, 4] = np.nan
    observed = episodes.observed[10] & measured
    for each in (filters, healthy):
        each.update(episodes.everyone, observed, episodes.values[10], SIGMA)
    assert filters.diverged.tolist() == [False, True, False]
    np.testing.assert_array_equal(filters.innovations[1], 0.0)
    np.testing.assert_allclose(filters.members[1].mean(axis=0), episodes.start[1], rtol=0.3)
    np.testing.assert_array_equal(filters.members[[0, 2]], healthy.members[[0, 2]])
    run(filters, episodes, [11])
    assert not filters.diverged.any()


@both_backends
@both_bounds
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_measurement_that_is_not_finite_is_not_projected_away(backend, bounds, bad):
    episodes = simulate(n_steps=1)
    filters = started(episodes, backend=backend, bounds=bounds)
    filters.predict(episodes.everyone, episodes.inputs[0])
    values = episodes.values[0].copy()
    values[0, 14, 0] = bad
    filters.update(episodes.everyone, np.arange(19)[None] == 14, values, SIGMA)
    assert filters.diverged.all()
    np.testing.assert_array_equal(filters.innovations, 0.0)


@both_backends
def test_outputs_that_are_known_exactly_and_twice_over_diverge(backend):
    """Without noise more outputs than members leave no definite S: flagged, not solved."""
    episodes = simulate(n_steps=1)
    filters = started(episodes, backend=backend, enkf=EnsembleSettings(n_members=4))
    filters.predict(episodes.everyone, episodes.inputs[0])
    everything = np.ones((1, 19), bool)
    filters.update(episodes.everyone, everything, episodes.values[0], np.zeros(2))
    assert filters.diverged.all()
    assert np.isfinite(filters.members).all()


# Streams ------------------------------------------------------------------------------------------


@both_backends
def test_what_is_measured_does_not_change_how_members_are_disturbed(backend):
    episodes = simulate(n_steps=12)
    seeing, blind = (started(episodes, backend=backend) for _ in range(2))
    nothing = np.zeros((1, 19), bool)
    for k in range(11):
        for filters, observed in ((seeing, episodes.observed[k]), (blind, nothing)):
            filters.predict(episodes.everyone, episodes.inputs[k])
            filters.update(episodes.everyone, observed, episodes.values[k], SIGMA)
    assert not np.array_equal(seeing.members, blind.members)
    for filters in (seeing, blind):  # from the same members
        if backend is CompiledEnKF:
            filters._ensembles.swarms[:] = episodes.start[:, :, None]
        else:
            filters.members[:] = episodes.start[:, None]
        filters.predict(episodes.everyone, episodes.inputs[11])
    np.testing.assert_array_equal(seeing.members, blind.members)
