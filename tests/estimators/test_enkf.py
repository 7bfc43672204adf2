"""The ensemble Kalman filter beside its reference, the Kalman filter and the EKF; its options."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    DemandSettings,
    EnsembleSettings,
    EstimatorSettings,
    make_estimator,
)
from dptse_env.estimators.enkf import gaspari_cohn, make_tapers, positions
from dptse_env.model import ARZModel, MeasurementRows, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY
from tests.helpers import Road, pairwise

from .episodes import SIGMA, random_streams, run, simulate, started, tell
from .rows import averaged, every_row, update, with_rows

FIELDS = ("density", "speed", "density_std", "speed_std")
EPISODES = {
    "speed": lambda: simulate("paper", n=2, n_steps=25),
    "flow": lambda: simulate(n_steps=25, release="flow"),
    "rows": lambda: averaged(25),
}
OPTIONS = {
    "plain": {},
    "inflation": {"enkf": EnsembleSettings(inflation=1.1)},
    "taper": {"enkf": EnsembleSettings(inflation=1.02, taper=0.35, n_members=31)},
    "densities": {"demand": DemandSettings(), "density_growth": 0.05, "count_noise": 0.7},
}
both_backends = pytest.mark.parametrize("backend", BACKENDS)


def take(filters, episodes, k):
    """Take a step of episodes with rows."""
    filters.predict(episodes.everyone, episodes.inputs[k])
    update(filters, episodes, k)


# Against oracles ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "bounds", "options"), pairwise(EPISODES, ["cone", "box"], OPTIONS)
)
def test_it_takes_the_steps_of_its_reference(kind, bounds, options):
    """Both draw the same numbers."""
    episodes, settings = EPISODES[kind](), EstimatorSettings(bounds=bounds, **OPTIONS[options])
    compiled, reference = (started("enkf", each, episodes, settings) for each in BACKENDS)
    unit = compiled.model.state_scale
    for k in range(25):
        for filters in (compiled, reference):
            take(filters, episodes, k) if kind == "rows" else run(filters, episodes, [k])
        np.testing.assert_allclose(compiled.members / unit, reference.members / unit, atol=1e-9)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-6)
        np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
        a, b = compiled.estimate(), reference.estimate()
        for field in FIELDS:
            np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)
        assert not np.any(compiled.diverged | reference.diverged)
        if bounds == "box":  # leaves psi / rho without a bound, and there rounding grows
            for each, members in zip(reference.filters, compiled.members, strict=True):
                each.members = members / unit
    assert (compiled.innovations[episodes.observed[24]] != 0.0).all()
    np.testing.assert_array_equal(compiled.innovations[~episodes.observed[24]], 0.0)


def linear_errors(n_members, n_seeds=200, n_steps=20):
    """Errors of mean and covariance against the Kalman filter, over its deviations, by seed.

    A cell that nobody enters or leaves, before a jam: x = F x + w, z = H x + offset + v.
    """
    v_f, rho_m, tau, noise, initial = 102.0, 333.0, 60.0, 2e-5, 1e-8
    floor, unit = 0.01 * rho_m, np.array([rho_m, rho_m * v_f])
    f, h = np.array([[1.0, 0.0], [v_f / tau, 1.0 - 1.0 / tau]]), np.diag([1.0, 1.0 / floor])
    q, x, p = np.diag((noise * unit) ** 2), np.array([2.0, 160.0]), np.diag(initial * unit**2)
    offset, sigma = np.array([0.0, -v_f * 0.01**2]), np.array([0.05, 2.0])
    disturbance = sigma * np.random.default_rng(0).normal(size=(n_steps, 2))
    model = ARZModel(Road(n_mainline=1), load_parameters("paper"))
    settings = EstimatorSettings(
        process_noise=(noise, noise),
        initial_variance=initial,
        enkf=EnsembleSettings(n_members=n_members),
    )
    filters = make_estimator("enkf", "compiled", model, n_seeds, settings)
    everyone, inputs = np.arange(n_seeds), np.tile([0.0, v_f, 1.2 * rho_m], (n_seeds, 1))
    filters.reset(everyone, np.tile(x, (n_seeds, 1)), random_streams(n_seeds))
    for z in np.array([2.0, 1.6 * v_f / floor]) + offset + disturbance:
        filters.predict(everyone, inputs)
        values = np.broadcast_to(z, (n_seeds, 1, 2))
        tell(filters, everyone, np.ones((n_seeds, 1), bool), values, sigma)
        x, p = f @ x, f @ p @ f.T + q
        s = h @ p @ h.T + np.diag(sigma**2)
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ (z - h @ x - offset), p - gain @ s @ gain.T
    deviation = np.sqrt(np.diag(p))
    covariances = filters.covariances * np.outer(unit, unit)
    return (filters.states - x) / deviation, (covariances - p) / np.outer(deviation, deviation)


def test_mean_over_seeds_is_the_kalman_filters():
    mean, covariance = linear_errors(400)
    for errors in (mean, covariance.reshape(200, 4)):
        standard_error = errors.std(axis=0) / np.sqrt(len(errors))
        # The bias of a finite ensemble falls as 1 / M.
        assert (np.abs(errors.mean(axis=0)) < 4.0 * standard_error + 3.0 / 400).all()


@pytest.mark.slow
def test_approaches_the_kalman_filter_as_one_over_the_root_of_the_members():
    spreads = {}
    for n_members in (25, 100, 400):
        mean, covariance = linear_errors(n_members)
        spreads[n_members] = np.sqrt(np.mean(mean**2)), np.sqrt(np.mean(covariance**2))
    for i in range(2):
        logs = np.log([spread[i] for spread in spreads.values()])
        slope = np.polyfit(np.log(list(spreads)), logs, 1)[0]
        assert slope == pytest.approx(-0.5, abs=0.08)
    # A mean of M independent draws is off by 1 / sqrt(M) deviations; updates correlate them.
    assert spreads[100][0] < 0.2


@pytest.mark.parametrize("options", ["plain", "densities"])
def test_many_members_find_what_the_ekf_does_where_all_is_nearly_linear(options):
    """On rows of one to three segments that are measured precisely, near the predicted path."""
    episodes, n_steps, rng = averaged(12), 12, np.random.default_rng(5)
    model, path = episodes.model, [episodes.start]
    for inputs in episodes.inputs:
        path.append(model.project(model.step(path[-1], inputs)))
    sigma = np.broadcast_to([0.03, 1.5], episodes.sigma.shape)
    exact = [model.measure(x, v_0) for x, v_0 in zip(path[1:], episodes.centre, strict=True)]
    values = np.stack(exact) + sigma * rng.normal(size=sigma.shape)
    episodes = replace(episodes, values=values, sigma=sigma)
    given = {
        "plain": {},
        "densities": {
            "demand": DemandSettings(deviation=1e-3, walk=1e-4),
            "density_growth": 1e-4,
            "count_noise": 2e-5,
        },
    }[options]
    settings = EstimatorSettings(
        process_noise=(1e-5, 1e-5),
        initial_variance=1e-9,
        enkf=EnsembleSettings(n_members=8000),
        **given,
    )
    many, one = (started(name, "compiled", episodes, settings) for name in ("enkf", "ekf"))
    for k in range(n_steps):
        for filters in (many, one):
            take(filters, episodes, k)
    mean, covariance = one.states[0], one.covariances[0]
    deviation = np.sqrt(np.diag(covariance))
    off = (many.states[0] - mean) / (deviation * one.model.state_scale)
    # A mean of all members is off by 0.01 deviations, and gains by as much in each update.
    assert np.abs(off).max() < 0.15
    assert np.sqrt(np.mean(off**2)) < 0.06
    correlations = (many.covariances[0] - covariance) / np.outer(deviation, deviation)
    assert np.abs(correlations).max() < 0.08
    np.testing.assert_allclose(many.innovations, one.innovations, atol=0.1)


# Options ------------------------------------------------------------------------------------------


def test_inflation_alone_scales_distances_from_the_mean():
    """With worthless measurements and room to the bounds nothing else moves the members."""
    episodes = simulate(n_steps=1)
    settings = EstimatorSettings(
        initial_variance=1e-8, bounds="box", enkf=EnsembleSettings(inflation=1.5)
    )
    filters = started("enkf", "compiled", episodes, settings)
    before, covariances = filters.states, filters.covariances
    nothing = np.zeros((1, 19), bool)
    tell(filters, episodes.everyone, nothing, episodes.values[0], SIGMA)
    np.testing.assert_array_equal(filters.covariances, covariances)
    tell(filters, episodes.everyone, episodes.observed[0], episodes.values[0], 1e12 * SIGMA)
    np.testing.assert_allclose(filters.states, before, rtol=1e-9)
    np.testing.assert_allclose(filters.covariances, 1.5**2 * covariances, rtol=1e-6)


def test_a_tapered_row_acts_near_any_of_its_segments_and_on_the_factor_of_a_near_entry():
    episodes = averaged(10)
    settings = EstimatorSettings(demand=DemandSettings(), enkf=EnsembleSettings(taper=0.25))
    filters, rows = started("enkf", "compiled", episodes, settings), episodes.model.rows
    for k in range(9):
        take(filters, episodes, k)
    filters.predict(episodes.everyone, episodes.inputs[9])
    before = filters.members
    only = ((rows.first == 1) & (rows.span == 3))[None]
    update(filters, episodes, 9, only)
    moved = np.abs(filters.members - before).max(axis=(0, 1)) > 1e-6
    near, factors = moved[:38].reshape(19, 2).any(axis=1), moved[38:]
    # Segments of 0.1 km, on-ramps at the faces 3 and 9 and off-ramps at 6 and 12.
    x = 0.1 * np.array([*(np.arange(15) + 0.5), 3, 9, 6, 12])
    reached = (np.abs(x[:, None] - x[[1, 2, 3]]) < 0.25).any(axis=1)
    np.testing.assert_array_equal(near, reached)
    np.testing.assert_array_equal(factors, reached[[0, 15, 16]])


def test_a_taper_leaves_a_definite_s_where_a_few_members_do_not():
    """Known exactly, 22 outputs of 4 members have no definite S: flagged, not solved."""
    episodes = averaged(1)
    exact = np.zeros_like(episodes.sigma[0])
    only = (np.arange(episodes.model.rows.n_rows) % 4 == 0)[None]
    for taper, diverges in ((None, True), (0.2, False)):
        enkf = EnsembleSettings(n_members=4, taper=taper)
        for backend in BACKENDS:
            filters = started("enkf", backend, episodes, EstimatorSettings(enkf=enkf))
            filters.predict(episodes.everyone, episodes.inputs[0])
            given = episodes.values[0], exact, episodes.centre[0]
            tell(filters, episodes.everyone, only, *given)
            np.testing.assert_array_equal(filters.diverged, diverges)
            assert np.isfinite(filters.members).all()


@pytest.mark.parametrize("taper", [None, 0.35])
def test_single_rows_among_others_that_nobody_measures_change_nothing(taper):
    plain = simulate(n_steps=8, release="flow")
    more = with_rows(plain.model, every_row(19, 15))
    settings = EstimatorSettings(enkf=EnsembleSettings(taper=taper))
    without = started("enkf", "compiled", plain, settings)
    among = started("enkf", "compiled", replace(plain, model=more), settings)
    observed, values = np.zeros((1, more.rows.n_rows), bool), np.zeros((1, more.rows.n_rows, 2))
    for k in range(8):
        run(without, plain, [k])
        observed[:, :19], values[:, :19] = plain.observed[k], plain.values[k]
        among.predict(plain.everyone, plain.inputs[k])
        tell(among, plain.everyone, observed, values, plain.sigma)
        np.testing.assert_array_equal(among.members, without.members)
        np.testing.assert_array_equal(among.innovations[:, :19], without.innovations)


# Tapers -------------------------------------------------------------------------------------------


def test_gaspari_cohn_is_a_convolution_of_tents():
    """Eq. 4.10 is the self-convolution over space of a tent of half the reach, normalised."""
    # In three dimensions, along an axis: integrate tent(|r|) tent(|r - d|) over cylinders.
    half, step = 0.5, 0.01
    z = np.arange(-0.5 + step / 2, 1.5, step)
    z, radius = np.meshgrid(z, np.arange(step / 2, 0.5, step))

    def overlap(distance):
        tent = np.maximum(0.0, 1.0 - np.hypot(z, radius) / half)
        other = np.maximum(0.0, 1.0 - np.hypot(z - distance, radius) / half)
        return np.sum(tent * other * radius)

    distances = np.linspace(0.0, 1.5, 16)
    expected = [overlap(d) / overlap(0.0) for d in distances]
    np.testing.assert_allclose(gaspari_cohn(distances, 1.0), expected, atol=2e-3)
    np.testing.assert_array_equal(gaspari_cohn(distances[distances >= 1.0], 1.0), 0.0)


def test_ramps_lie_at_the_face_where_they_join():
    x = positions(SHORT_HIGHWAY)  # on-ramp at face 2, off-ramp at face 4, segments of 0.1 km
    np.testing.assert_allclose(x, [0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.2, 0.4])


@pytest.mark.parametrize("reach", [0.05, 0.3, 2.0])
def test_weights_of_rows_and_states_are_averages_and_positive_semidefinite(reach):
    """Jointly with those among the components, at the segments and the factors' entries."""
    rows = MeasurementRows(np.array([0, 0, 1, 4, 8, 9, 12]), np.array([1, 2, 3, 5, 2, 3, 3]), 19)
    model = ARZModel(PAPER_HIGHWAY, load_parameters("w99-3lane"), 1.0, 51.0, rows, True)
    x, weights = positions(PAPER_HIGHWAY), make_tapers(model, reach)
    cells = np.concatenate([np.repeat(np.arange(19), 2), model.layout.entries])
    among = gaspari_cohn(np.abs(x[:, None] - x), reach)
    states = among[np.ix_(cells, cells)]
    np.testing.assert_allclose(weights.with_states[2], states[2:8:2].mean(axis=0), atol=1e-14)
    np.testing.assert_allclose(weights.among_rows[2, 3], among[1:4, 4:9].mean(), atol=1e-14)
    joint = np.block([[states, weights.with_states.T], [weights.with_states, weights.among_rows]])
    np.testing.assert_allclose(joint, joint.T, atol=1e-15)
    assert np.linalg.eigvalsh(joint).min() > -1e-12


# Soundness ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("backend", "bounds", "bad"),
    pairwise(BACKENDS, ["cone", "box"], [np.nan, np.inf, -np.inf], rest=False),
)
def test_a_measurement_that_is_not_finite_is_not_projected_away(backend, bounds, bad):
    episodes = simulate(n_steps=1)
    filters = started("enkf", backend, episodes, EstimatorSettings(bounds=bounds))
    filters.predict(episodes.everyone, episodes.inputs[0])
    values = episodes.values[0].copy()
    values[0, 14, 0] = bad
    tell(filters, episodes.everyone, np.arange(19)[None] == 14, values, SIGMA)
    assert filters.diverged.all()
    np.testing.assert_array_equal(filters.innovations, 0.0)


@both_backends
def test_what_is_measured_does_not_change_how_members_are_disturbed(backend):
    episodes = simulate(n_steps=6)
    seeing, blind = (started("enkf", backend, episodes) for _ in range(2))
    for k in range(6):
        for filters, seen in ((seeing, episodes.observed[k]), (blind, np.zeros((1, 19), bool))):
            filters.predict(episodes.everyone, episodes.inputs[k])
            tell(filters, episodes.everyone, seen, episodes.values[k], 1e12 * SIGMA)
    np.testing.assert_allclose(seeing.members, blind.members, rtol=1e-7)
