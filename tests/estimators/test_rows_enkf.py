"""The ensemble Kalman filter under rows over several segments, and with demand states."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    DemandSettings,
    EnsembleSettings,
    EstimatorSettings,
    make_estimator,
)
from dptse_env.model import ARZModel, MeasurementRows, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY

from .draws import draw_alike
from .episodes import random_streams

both_backends = pytest.mark.parametrize("backend", BACKENDS)

FIELDS = ("density", "speed", "density_std", "speed_std")
# Rows of one, two and three segments of the paper's highway, which overlap.
ROWS = ([0, 0, 1, 3, 4, 6, 8, 8, 10, 12, 17], [1, 2, 3, 2, 3, 1, 3, 2, 2, 3, 1])
PAIRS = ([0, 1, 3, 6, 7], [2, 2, 2, 1, 1])  # of the short highway, ramps last


@dataclass(frozen=True)
class Watched:
    """n episodes of K steps in free flow, with rows, deviations and centres of their own."""

    model: ARZModel
    start: np.ndarray  # (n, 2 S)
    inputs: np.ndarray  # (K, n, n_u)
    observed: np.ndarray  # (K, n, M)
    values: np.ndarray  # (K, n, M, 2)
    sigma: np.ndarray  # (K, n, M, 2)
    centre: np.ndarray  # (K, n, S)

    def repeated(self, n):
        """The first episode, n times."""
        start = np.repeat(self.start[:1], n, axis=0)
        names = ("inputs", "observed", "values", "sigma", "centre")
        parts = {name: np.repeat(getattr(self, name)[:, :1], n, axis=1) for name in names}
        return replace(self, start=start, **parts)


def watch(corridor, rows, n=1, n_steps=12, share=0.6, deviation=6.0, scatter=0.2, surge=1.0):
    """Traffic in disorder by a share `scatter`, of `surge` times the demand that inputs say.

    A `share` of the rows are measured, with deviations around `deviation` [veh/km].
    """
    rows = MeasurementRows(*(np.array(part) for part in rows), corridor.n_segments)
    model = ARZModel(corridor, load_parameters("w99-3lane"), reference_speed=51.0, rows=rows)
    rng = np.random.default_rng(0)
    jam, v_f, s = model.jam_density, model.parameters.free_flow_speed, model.n_segments
    start = model.states(np.full((n, s), 0.07) * jam, np.full((n, s), 0.65 * v_f))
    x = start * rng.uniform(1.0 - scatter, 1.0 + scatter, start.shape)
    boundary = np.full((n, model.n_boundaries), 0.06 * model.density_scale)
    boundary[:, 2:] /= 3.0
    inputs = model.boundary_inputs(boundary, np.full(boundary.shape, 0.7 * v_f))
    served = inputs.copy()
    served[:, model.layout.entry_inputs] *= surge

    shape = (n_steps, n, rows.n_rows)
    centre = rng.uniform(20.0, 90.0, (n_steps, n, s))
    sigma = deviation * rng.uniform(0.5, 2.0, (*shape, 2)) * np.array([1.0, 50.0])
    values = np.empty((*shape, 2))
    for k in range(n_steps):
        x = model.step(x, served)
        values[k] = model.measure(x, centre[k]) + sigma[k] * rng.normal(size=(*shape[1:], 2))
    told = np.repeat(inputs[None], n_steps, axis=0)
    return Watched(model, start, told, rng.random(shape) < share, values, sigma, centre)


def begun(name, backend, episodes, settings):
    n = len(episodes.start)
    filters = make_estimator(name, backend, episodes.model, n, settings)
    filters.reset(np.arange(n), episodes.start, random_streams(n))
    return filters


def take(filters, episodes, k):
    everyone = np.arange(len(episodes.start))
    filters.predict(everyone, episodes.inputs[k])
    parts = (episodes.observed, episodes.values, episodes.sigma, episodes.centre)
    filters.update(everyone, Measurement.of(filters.model, *(part[k] for part in parts)))


# Backends -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bounds", ["cone", "box"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"demand": DemandSettings(), "density_growth": 0.05, "count_noise": 0.7},
        {"demand": DemandSettings(), "enkf": EnsembleSettings(taper=0.35, n_members=31)},
        {"count_noise": 2.0, "enkf": EnsembleSettings(taper=0.35, inflation=1.1)},
    ],
    ids=["plain", "densities", "taper", "inflation"],
)
def test_given_the_same_draws_backends_agree(bounds, options):
    episodes = watch(PAPER_HIGHWAY, ROWS, n=2, n_steps=25)
    settings = EstimatorSettings(bounds=bounds, **options)
    compiled, reference = (begun("enkf", kind, episodes, settings) for kind in BACKENDS)
    draw_alike(compiled, reference)
    unit = compiled.model.state_scale
    for k in range(25):
        for filters in (compiled, reference):
            take(filters, episodes, k)
        np.testing.assert_allclose(compiled.members / unit, reference.members / unit, atol=1e-9)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-6)
        np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
        if bounds == "box":  # leaves psi / rho without a bound, and there rounding grows
            reference.members[:] = compiled.members
    assert not compiled.diverged.any()
    assert (compiled.innovations[episodes.observed[24]] != 0.0).all()
    np.testing.assert_array_equal(compiled.innovations[~episodes.observed[24]], 0.0)


def test_backends_are_equal_in_distribution():
    """Estimates and what they claim, over 150 seeds each on the same traffic."""
    n = 150
    episodes = watch(PAPER_HIGHWAY, ROWS, n_steps=6).repeated(n)
    settings = EstimatorSettings(demand=DemandSettings(), density_growth=0.03, count_noise=0.5)
    drawn = {}
    for backend in BACKENDS:
        filters = begun("enkf", backend, episodes, settings)
        for k in range(6):
            take(filters, episodes, k)
        estimate, factors = filters.estimate(), filters.model.demand_factors(filters.members)
        shown = [getattr(estimate, field) for field in FIELDS]
        drawn[backend] = np.concatenate([*shown, factors.mean(axis=1), factors.std(axis=1)], axis=1)
    a, b = (drawn[backend] for backend in BACKENDS)
    error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / n)
    scores = (a.mean(axis=0) - b.mean(axis=0)) / error
    assert np.abs(scores).max() < 4.5
    assert np.sqrt(np.mean(scores**2)) < 1.4
    ratios = np.log(a.var(axis=0) / b.var(axis=0))  # each off by sqrt(4 / 150), about
    assert abs(ratios.mean()) < 0.1
    assert np.abs(ratios).max() < 0.8


# The extended Kalman filter -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"demand": DemandSettings(deviation=0.1, walk=0.01)},
        {"density_growth": 1e-3, "count_noise": 2e-3},
    ],
    ids=["rows", "demand", "densities"],
)
def test_many_members_find_what_the_extended_filter_does_where_all_is_nearly_linear(options):
    n, n_members = 12, 1500
    close = {"deviation": 0.1, "scatter": 0.005, "surge": 1.15 if "demand" in options else 1.0}
    episodes = watch(SHORT_HIGHWAY, PAIRS, n_steps=15, share=0.7, **close).repeated(n)
    members = EnsembleSettings(n_members=n_members)
    settings = EstimatorSettings(
        process_noise=(1e-4, 1e-4), initial_variance=1e-7, enkf=members, **options
    )
    many, one = (begun(name, "compiled", episodes, settings) for name in ("enkf", "ekf"))
    for k in range(15):
        for filters in (many, one):
            take(filters, episodes, k)
    mean, covariance = one.states[0], one.covariances[0]
    deviation = np.sqrt(np.diag(covariance))
    off = (many.states - mean) / (deviation * one.model.state_scale)
    # The standard error of a mean of all members, and what little is not linear.
    assert np.abs(off.mean(axis=0)).max() < 5.0 / np.sqrt(n * n_members) + 0.02
    correlations = (many.covariances.mean(axis=0) - covariance) / np.outer(deviation, deviation)
    assert np.abs(correlations).max() < 0.05
    found = (one.innovations[0] != 0.0).ravel()
    innovations = many.innovations.mean(axis=0).ravel()[found]
    np.testing.assert_allclose(innovations, one.innovations[0].ravel()[found], atol=0.05)


@both_backends
def test_demand_factors_follow_the_demand(backend):
    surge = {"surge": 1.15, "deviation": 0.5}
    episodes = watch(SHORT_HIGHWAY, PAIRS, n=4, n_steps=60, share=1.1, **surge)
    settings = EstimatorSettings(process_noise=(1e-3, 1e-3), demand=DemandSettings())
    filters = begun("enkf", backend, episodes, settings)
    factors = filters.model.demand_factors
    prior = factors(filters.members)
    np.testing.assert_allclose(prior.mean(axis=(0, 1)), 1.0, atol=0.05)
    np.testing.assert_allclose(prior.std(axis=(0, 1)), 0.2, rtol=0.15)
    late = []
    for k in range(60):
        take(filters, episodes, k)
        late.append(factors(filters.states))
    np.testing.assert_allclose(np.mean(late[20:], axis=(0, 1)), 1.15, atol=0.06)
    assert not filters.diverged.any()


# Single rows, and tapers --------------------------------------------------------------------------


@both_backends
@pytest.mark.parametrize("taper", [None, 0.35])
def test_single_rows_among_others_that_nobody_measures_change_nothing(backend, taper):
    s = PAPER_HIGHWAY.n_segments
    alone = watch(PAPER_HIGHWAY, (range(s), [1] * s), n=2, share=0.4)
    sigma = np.broadcast_to([5.0, 250.0], alone.sigma.shape)
    alone = replace(alone, sigma=sigma, centre=np.full_like(alone.centre, 51.0))
    rows = (np.concatenate([range(s), ROWS[0]]), np.concatenate([[1] * s, ROWS[1]]))
    model = watch(PAPER_HIGHWAY, rows).model

    def widened(part, by):
        shape = (*part.shape[:2], len(ROWS[0]), *part.shape[3:])
        return np.concatenate([part, np.full(shape, by, dtype=part.dtype)], axis=2)

    among = replace(
        alone,
        model=model,
        observed=widened(alone.observed, False),
        values=widened(alone.values, 7.0),
        sigma=widened(alone.sigma, 3.0),
    )
    plain = ARZModel(PAPER_HIGHWAY, load_parameters("w99-3lane"), reference_speed=51.0)
    settings = EstimatorSettings(enkf=EnsembleSettings(taper=taper))
    default = begun("enkf", backend, replace(alone, model=plain), settings)
    others = [begun("enkf", backend, episodes, settings) for episodes in (alone, among)]
    everyone = np.arange(2)
    for k in range(12):
        default.predict(everyone, alone.inputs[k])
        default.update(everyone, Measurement.of(default.model, alone.observed[k], alone.values[k], np.array([5.0, 250.0])))
        for filters, episodes in zip(others, (alone, among), strict=True):
            take(filters, episodes, k)
            np.testing.assert_array_equal(filters.members, default.members)
            np.testing.assert_array_equal(filters.innovations[:, :s], default.innovations)


@both_backends
def test_tapers_of_wide_rows_leave_a_definite_s(backend):
    """Without noise, 4 members leave no definite S of 22 outputs, and a taper restores one."""
    episodes = watch(PAPER_HIGHWAY, ROWS, n=20, n_steps=1, share=1.1)
    exact = replace(episodes, sigma=np.zeros_like(episodes.sigma))
    for taper, diverges in ((None, True), (0.25, False)):
        options = EnsembleSettings(n_members=4, taper=taper)
        filters = begun("enkf", backend, exact, EstimatorSettings(enkf=options))
        take(filters, exact, 0)
        np.testing.assert_array_equal(filters.diverged, diverges)


@both_backends
def test_a_tapered_row_acts_near_any_of_its_segments_and_on_the_factor_of_a_near_entry(backend):
    episodes = watch(PAPER_HIGHWAY, ROWS, n=5, n_steps=10)
    options = EnsembleSettings(taper=0.25)
    settings = EstimatorSettings(demand=DemandSettings(), enkf=options)
    filters = begun("enkf", backend, episodes, settings)
    for k in range(9):
        take(filters, episodes, k)
    everyone = np.arange(5)
    filters.predict(everyone, episodes.inputs[9])
    before = filters.members.copy()
    only = np.repeat(np.arange(len(ROWS[0]))[None] == 2, 5, axis=0)  # segments 1, 2 and 3
    filters.update(everyone, Measurement.of(filters.model, only, episodes.values[9], episodes.sigma[9], episodes.centre[9]))
    moved = np.abs(filters.members - before).max(axis=(0, 1)) > 1e-6
    near, factors = moved[:38].reshape(19, 2).any(axis=1), moved[38:]
    x = segment_positions(PAPER_HIGHWAY)
    reached = (np.abs(x[:, None] - x[[1, 2, 3]]) < 0.25).any(axis=1)
    np.testing.assert_array_equal(near, reached)
    np.testing.assert_array_equal(factors, reached[filters.model.layout.entries])
    assert factors.any()
    assert not factors.all()


def segment_positions(corridor):
    """Centres of mainline segments and faces of ramps [km]."""
    faces = [*corridor.on_ramps, *corridor.off_ramps]
    return corridor.segment_length * np.array([*(np.arange(corridor.n_mainline) + 0.5), *faces])
