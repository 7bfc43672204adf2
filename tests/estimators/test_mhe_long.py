"""The compiled moving horizon estimator on long roads, and on programs that are hard to solve."""

import copy

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    DemandSettings,
    EstimatorSettings,
    HorizonSettings,
    make_estimator,
)
from dptse_env.estimators.horizon import assemble, natural_residual, normalised_bounds, solve
from dptse_env.model import ARZModel
from dptse_env.model.parameters import load_parameters

from ..model.roads import UNEVEN, Road
from .episodes import REFERENCE_SPEEDS, SIGMAS, random_streams, run, simulate, started

ONE = np.array([0])
# A model that is trusted almost entirely ties the whole window together: a bound that binds in one
# second moves the states of all the others.
TRUSTED = {"process_noise": (1e-4, 2e-4), "density_growth": 0.015}


def long_road(n_mainline):
    on, off = range(8, n_mainline - 4, 16), range(15, n_mainline - 4, 16)
    return Road(n_mainline, tuple(on), tuple(off), (0.1,) * len(off))


def hostile(n_mainline, release, wildness, n_steps, seed=0, **settings):
    """Drive an estimator by releases without any sense; yields it after every update.

    A jam fills a third of the road from its middle on, the rest is empty.
    """
    rng = np.random.default_rng(seed)
    road, parameters = long_road(n_mainline), load_parameters("w99-3lane")
    model = ARZModel(road, parameters, reference_speed=REFERENCE_SPEEDS[release])
    demand = DemandSettings() if release == "flow" else None
    settings = EstimatorSettings(demand=demand, **settings)
    mhe = make_estimator("mhe", "compiled", model, 1, settings)
    s, jam, v_f = model.n_segments, model.jam_density, model.parameters.free_flow_speed
    place = np.arange(s)
    is_jam = (place > n_mainline // 2) & (place < n_mainline // 2 + n_mainline // 3)
    filling = np.where(is_jam, 0.9, 0.0)
    states = model.states((filling * jam)[None], np.where(is_jam, 0.02, 0.9)[None] * v_f)
    mhe.reset(ONE, states, random_streams(1))
    boundary = np.full((1, 2 + s - n_mainline), 0.1) * model.density_scale
    inputs = model.boundary_inputs(boundary, np.full_like(boundary, 0.8 * v_f))
    sigma = SIGMAS[release]
    for _ in range(n_steps):
        mhe.predict(ONE, inputs)
        observed = rng.random((1, s)) < 0.4
        truth = model.measure(mhe.states[:, : 2 * s])
        values = truth + wildness * sigma * rng.normal(size=(1, s, 2))
        mhe.update(ONE, observed, values, sigma)
        yield mhe


def test_a_copy_goes_on_alike_and_every_thread_has_its_space():
    """A copy leaves the working spaces behind."""
    mhe = next(iter(hostile(80, "speed", 1.0, 1)))
    twin = copy.deepcopy(mhe)
    observed = np.ones((1, mhe.model.n_segments), dtype=bool)
    for each in (mhe, twin):
        each.predict(ONE, mhe.model.boundary_inputs(*np.full((2, 1, mhe.model.n_boundaries), 30.0)))
        values = each.model.measure(each.states)
        each.update(ONE, observed, values, SIGMAS["speed"])
    np.testing.assert_array_equal(mhe.states, twin.states)
    np.testing.assert_array_equal(mhe.covariances, twin.covariances)
    spaces = mhe._spaces
    with spaces.lend() as one, spaces.lend() as other:
        assert not np.shares_memory(one[0], other[0])
    with spaces.lend() as again:
        assert np.shares_memory(again[0], one[0]) or np.shares_memory(again[0], other[0])


def program(mhe):
    """H, q, bounds and solution of the last program."""
    H, q = assemble(mhe.window(0))
    n_stages = len(q) // mhe.model.n_states
    bounds = (np.tile(b, n_stages) for b in normalised_bounds(mhe.model, mhe.settings.mhe.bounds))
    z = mhe._windows.solution[0, :n_stages, : mhe.model.n_states].ravel()
    return H, q, *bounds, z


@pytest.mark.parametrize("bounds", ["box", "cone"])
@pytest.mark.parametrize("release", ["speed", "flow"])
def test_many_bounds_that_bind_on_a_long_road_are_those_of_another_solver(release, bounds):
    """64 segments, of which most are empty or jammed, under releases that are mostly noise."""
    held = []
    mhe_settings = HorizonSettings(horizon=5, bounds=bounds)
    for k, mhe in enumerate(hostile(64, release, 8.0, 9, mhe=mhe_settings)):
        assert not np.any(mhe.fallback | mhe.diverged)
        if k % 4 == 0:
            H, q, lower, upper, z = program(mhe)
            other = solve(H, q, lower, upper, "piqp")
            np.testing.assert_allclose(z, other, rtol=0, atol=1e-9)
            assert natural_residual(H, q, lower, upper, z) < 1e-9
            held.append(int(((z == lower) | (z == upper)).sum()))
    assert mhe.n_passed_on == 0
    assert max(held) > 100


@pytest.mark.parametrize("linearisation", ["paper", "trajectory"])
def test_no_program_is_far_from_its_solution(linearisation):
    """Rounds, each at most a factorisation in proportion to the road, on hard programs."""
    rounds = []
    horizon = HorizonSettings(linearisation=linearisation, bounds="box")
    for n_mainline, wildness in ((64, 3.0), (64, 30.0), (160, 10.0)):
        for mhe in hostile(n_mainline, "flow", wildness, 25, mhe=horizon, **TRUSTED):
            assert not np.any(mhe.fallback | mhe.diverged)
            rounds.append(int(mhe._windows.rounds[0]))
        assert mhe.n_passed_on == 0
    assert max(rounds) <= 120
    assert np.median(rounds) >= 3  # they are hard


@pytest.mark.usefixtures("along_the_road")
def test_covariances_are_those_of_the_last_update_whenever_they_are_asked_for():
    """The window moves on before they are computed; three episodes in different states."""
    episodes = simulate(n=3, n_steps=12)
    mhe = started("mhe", "compiled", episodes, EstimatorSettings(mhe=HorizonSettings(horizon=4)))
    run(mhe, episodes, range(9))
    expected = [np.linalg.inv(assemble(mhe.window(e))[0])[-38:, -38:] for e in range(3)]
    variances = np.array([np.diag(P) for P in expected])
    assert np.abs(expected[0][0, 20:]).max() > 1e-9  # far segments are related
    mhe.predict(np.array([0, 1]), episodes.inputs[9, :2])
    mhe.predict(np.array([0]), episodes.inputs[10, :1])
    shown = mhe.estimate().density_std / episodes.model.density_scale
    np.testing.assert_allclose(shown**2, variances[:, ::2], rtol=1e-6)
    np.testing.assert_allclose(mhe.covariances, expected, rtol=0, atol=1e-10)
    mhe.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    np.testing.assert_array_equal(mhe.covariances[1], 1e-3 * np.eye(38))
    np.testing.assert_allclose(mhe.covariances[2], expected[2], rtol=0, atol=1e-10)


@pytest.mark.usefixtures("along_the_road")
def test_two_predictions_without_an_update_move_a_full_window_twice():
    episodes = simulate(n_steps=12)
    settings = EstimatorSettings(mhe=HorizonSettings(horizon=4))
    compiled, reference = (started("mhe", kind, episodes, settings) for kind in BACKENDS)
    for mhe in (compiled, reference):
        run(mhe, episodes, range(8))
        mhe.predict(episodes.everyone, episodes.inputs[8])
        mhe.predict(episodes.everyone, episodes.inputs[9])
        run(mhe, episodes, [10, 11])
    np.testing.assert_allclose(compiled.states, reference.states, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(compiled.covariances, reference.covariances, rtol=0, atol=1e-10)


@pytest.mark.usefixtures("order")
def test_a_road_of_segments_of_many_kinds_is_estimated_alike():
    """Lengths, lanes and limits vary, ramps have several segments."""
    model = ARZModel(UNEVEN, load_parameters("w99-3lane"))
    rng, s, v_f = np.random.default_rng(0), model.n_segments, model.speed_scale
    start = model.states(0.2 * model.jam_density[None], np.full((1, s), 0.5 * v_f))
    settings = EstimatorSettings(mhe=HorizonSettings(horizon=4))
    both = [make_estimator("mhe", kind, model, 1, settings) for kind in BACKENDS]
    boundary = np.full((1, 2 + len(UNEVEN.on_ramps) + len(UNEVEN.off_ramps)), 10.0)
    inputs = model.boundary_inputs(boundary, np.full_like(boundary, 0.6 * v_f))
    for mhe in both:
        mhe.reset(ONE, start, random_streams(1))
    truth = model.measure(start)
    for _ in range(10):
        observed, noise = rng.random((1, s)) < 0.4, rng.normal(size=(1, s, 2))
        values = truth + 3.0 * SIGMAS["speed"] * noise
        for mhe in both:
            mhe.predict(ONE, inputs)
            mhe.update(ONE, observed, values, SIGMAS["speed"])
        np.testing.assert_allclose(both[0].states, both[1].states, rtol=1e-7, atol=1e-5)
        np.testing.assert_allclose(both[0].covariances, both[1].covariances, atol=1e-9)
        np.testing.assert_allclose(both[0].innovations, both[1].innovations, atol=1e-6)
