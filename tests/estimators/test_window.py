"""The program of a window and its solution, beside dense algebra and a general solver."""

from typing import NamedTuple

import numpy as np
import pytest

from dptse_env.estimators import window as parts
from dptse_env.estimators import with_demand
from dptse_env.estimators.linalg import padded
from dptse_env.estimators.reference import natural_residual, solve
from dptse_env.estimators.window import ACTIVE_SET, NEWTON, REFINED, Iterate, Window
from tests.helpers import UNEVEN, compiled

from .helpers import RICH, model_of

factorise, sweep = compiled(parts.factorise), compiled(parts.sweep)
evaluate, write_diagonal = compiled(parts.evaluate), compiled(parts.write_diagonal)
make_factor, minimise = compiled(parts.make_factor), compiled(parts.minimise)

MODEL = with_demand(model_of("w99-3lane", "rows", UNEVEN), RICH)
ROAD, CHANNELS, N = MODEL.road, MODEL.channels, MODEL.n_states
WIDTH, N_CHANNELS = padded(N), MODEL.channels.size


class Program(NamedTuple):
    """A window, and its objective z' H z + q' z as dense arrays."""

    window: Window
    H: np.ndarray
    q: np.ndarray

    @property
    def n_stages(self):
        return len(self.window.targets)

    def bounds(self):
        return (np.tile(b, self.n_stages) for b in (self.window.lower, self.window.upper))


def random_program(n_stages=4, spread=1.0):
    """A window of random transitions and rows, with bounds of 0 and 1, and its objective.

    Args:
        n_stages: Stages.
        spread: Deviation of what is measured from the middle of the bounds.
    """
    rng = np.random.default_rng(0)
    s, k, n_factors = ROAD.n_segments, ROAD.neighbours.shape[1], N - 2 * ROAD.n_segments
    window = Window(
        arrival=rng.normal(0.5, spread, N),
        arrival_variance=rng.uniform(0.1, 1.0, N),
        blocks=rng.normal(0.0, 0.5, (n_stages, s, k, 4)),
        by_factor=rng.normal(0.0, 0.5, (n_stages, n_factors, 3)),
        offsets=rng.normal(0.2, 0.1, (n_stages, N)),
        process_variance=rng.uniform(0.01, 0.1, (n_stages, N)),
        slopes=np.zeros((n_stages, s)),
        observed=rng.random((n_stages, N_CHANNELS)) < 0.3,
        weights=rng.normal(0.0, 1.0, (n_stages, N_CHANNELS, 2, 6)),
        targets=rng.normal(0.5, spread, (n_stages, N_CHANNELS, 2)),
        noise=0.01 * rng.uniform(0.5, 1.5, (n_stages, N_CHANNELS, 2)),
        lower=np.zeros(N),
        upper=np.ones(N),
    )
    # Drawn last, so that all else is as without.
    window.slopes[:] = rng.normal(0.0, 0.5, window.slopes.shape)
    return Program(window, *dense(window))


def transition(window, t):
    A = np.zeros((N, N))
    for c in range(ROAD.n_segments):
        for slot in range(ROAD.degree[c]):
            b = ROAD.neighbours[c, slot]
            A[2 * c : 2 * c + 2, 2 * b : 2 * b + 2] += window.blocks[t, c, slot].reshape(2, 2)
    for e in range(window.by_factor.shape[1]):
        factor = 2 * ROAD.n_segments + e
        A[2 * ROAD.entries[e] : 2 * ROAD.entries[e] + 2, factor] = window.by_factor[t, e, :2]
        A[factor, factor] = window.by_factor[t, e, 2]
    return A


def dense(window):
    """Sum up the squares of the objective, each |c - B z|^2 / variance."""
    n_stages = len(window.targets)
    H, q = np.zeros((n_stages * N, n_stages * N)), np.zeros(n_stages * N)

    def add(stages, B, c, variance):
        at = np.concatenate([np.arange(t * N, t * N + N) for t in stages])
        H[np.ix_(at, at)] += B.T @ (B / variance[:, None])
        q[at] -= 2.0 * B.T @ (c / variance)

    add([0], np.eye(N), window.arrival, window.arrival_variance)
    for t in range(n_stages - 1):
        B = np.hstack([-transition(window, t), np.eye(N)])
        whitening = np.eye(N)  # the inverse of L in Q = L D L'
        psi = np.arange(1, 2 * ROAD.n_segments, 2)
        whitening[psi, psi - 1] = -window.slopes[t]
        offsets = whitening @ window.offsets[t]
        add([t, t + 1], whitening @ B, offsets, window.process_variance[t])
    for t in range(n_stages):
        for m in np.flatnonzero(window.observed[t]):
            at, B = 2 * MODEL.channels.first[m], np.zeros((2, N))
            size = 2 * MODEL.channels.span[m]
            B[:, at : at + size] = window.weights[t, m, :, :size]
            add([t], B, window.targets[t, m], window.noise[t, m])
    return H, q


def iterate_at(program, z):
    """An iterate with a trajectory `(L, n_x)`."""
    shape = program.n_stages, WIDTH
    residuals = np.zeros((program.n_stages, 2 * N_CHANNELS))
    iterate = Iterate(np.zeros(shape), np.zeros(shape), residuals, np.zeros(shape))
    iterate.z[:, :N] = z
    evaluate(ROAD, CHANNELS, program.window, iterate)
    return iterate


def random_set(program, n_active, seed=1):
    active_set = np.zeros((program.n_stages, N), np.int64)
    at = np.random.default_rng(seed).choice(active_set.size, n_active, replace=False)
    active_set.flat[at] = 1
    return active_set


def factor_of(program, active_set):
    factor = make_factor(program.n_stages, N, N_CHANNELS, program.window.weights.shape[3], WIDTH)
    assert factorise(ROAD, CHANNELS, program.window, active_set, factor)
    return factor


def step_from(program, factor, iterate, from_gradient):
    step = np.empty((program.n_stages, WIDTH))
    sweep(ROAD, program.window, factor, 0, iterate, from_gradient, step)
    return step[:, :N]


def test_an_iterate_has_the_objectives_gradient():
    program = random_program()
    z = np.random.default_rng(2).random((4, N))
    found, diagonal = iterate_at(program, z).negative_gradient[:, :N], np.ones((4, WIDTH))
    expected = -program.H @ z.ravel() - program.q / 2
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-10)
    write_diagonal(ROAD, CHANNELS, program.window, diagonal)
    np.testing.assert_allclose(diagonal[:, :N].ravel(), np.diag(program.H), rtol=1e-12)


@pytest.mark.parametrize("from_gradient", [False, True])
@pytest.mark.parametrize("n_active", [0, 40])
def test_a_sweep_steps_to_the_minimum_with_components_fixed(n_active, from_gradient):
    program, z = random_program(), np.random.default_rng(2).random((4, N))
    active_set = random_set(program, n_active)
    factor, free = factor_of(program, active_set), active_set.ravel() == 0
    iterate, expected = iterate_at(program, z), np.zeros(free.size)
    negative_gradient = -program.H @ z.ravel() - program.q / 2
    inverse = np.linalg.inv(program.H[np.ix_(free, free)])
    expected[free] = inverse @ negative_gradient[free]
    step = step_from(program, factor, iterate, from_gradient)
    np.testing.assert_allclose(step.ravel(), expected, atol=1e-10)
    assert (step.ravel()[~free] == 0.0).all()
    last, end = free[-N:], np.zeros((N, N))
    end[np.ix_(last, last)] = inverse[-last.sum() :, -last.sum() :]
    np.testing.assert_allclose(factor.covariances[-1][:, :N], end, atol=1e-12)
    if n_active == 0:  # and before the last rows
        program.window.observed[-1] = False
        blind = np.linalg.inv(dense(program.window)[0])[-N:, -N:]
        np.testing.assert_allclose(factor.before[:, :N], blind, atol=1e-12)


def test_a_factor_is_renewed_from_the_first_stage_whose_set_differs():
    program, z = random_program(), np.random.default_rng(2).random((4, N))
    one, other = random_set(program, 30), random_set(program, 30, seed=4)
    other[:2] = one[:2]
    used = factor_of(program, one)
    assert factorise(ROAD, CHANNELS, program.window, other, used)
    fresh, iterate = factor_of(program, other), iterate_at(program, z)
    steps = [step_from(program, factor, iterate, False) for factor in (used, fresh)]
    np.testing.assert_array_equal(*steps)


@pytest.mark.parametrize(
    ("spread", "n_stages", "how"),
    [(0.0, 1, ACTIVE_SET), (0.3, 6, ACTIVE_SET), (1.0, 4, ACTIVE_SET), (3.0, 6, NEWTON)],
)
@pytest.mark.parametrize("guess", ["middle", "corner"])
def test_a_minimum_within_bounds_is_that_of_a_general_solver(spread, n_stages, how, guess):
    """With many components at bounds, too many for the active set."""
    program = random_program(n_stages, spread=spread)
    factor = factor_of(program, np.zeros((n_stages, N), np.int64))
    z, active_set = np.zeros((n_stages, WIDTH)), np.zeros((n_stages, WIDTH), np.int64)
    z[:, :N] = 0.5 if guess == "middle" else 0.0
    active_set[:, :N] = 0 if guess == "middle" else np.where(np.arange(N) % 7 == 0, -1, 0)
    found = minimise(ROAD, CHANNELS, program.window, factor, active_set, z)
    lower, upper = program.bounds()
    x = z[:, :N].ravel()
    assert found == how if guess == "middle" else found in (ACTIVE_SET, NEWTON)
    assert natural_residual(program.H, program.q, lower, upper, x) < 10.0 * REFINED
    right = solve(program.H, program.q, lower, upper)
    np.testing.assert_allclose(x, right, atol=1e-9)
    n_held = int(((x == lower) | (x == upper)).sum())
    assert n_held > 10 or spread == 0.0
