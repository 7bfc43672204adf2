"""The linear algebra that filters share, against dense numpy."""

import numpy as np
import pytest

from dptse_env.estimators import linalg
from dptse_env.model import ARZModel
from dptse_env.traffic import PAPER_HIGHWAY
from tests.helpers import compiled
from tests.model.oracle import PUBLISHED

add_product, factor, forward, is_covariance, mirror, apply, apply_transposed = (
    compiled(getattr(linalg, part))
    for part in (
        "add_product", "factor", "forward", "is_covariance", "mirror", "apply", "apply_transposed",
    )
)  # fmt: skip
pair_update, products, propagate, scalar_update, solve, solve_many = (
    compiled(getattr(linalg, part))
    for part in (
        "pair_update", "products", "propagate", "scalar_update", "solve", "solve_many",
    )
)  # fmt: skip

MODEL = ARZModel(PAPER_HIGHWAY.road, PUBLISHED, demand_memory=120.0)
ROAD, N = MODEL.road, MODEL.n_states
WIDTH = linalg.padded(N)


def random_covariance(rng, n=N):
    """A definite matrix, its rows padded with zeros."""
    root = 0.1 * rng.normal(size=(n, n))
    covariance = np.zeros((n, linalg.padded(n)))
    covariance[:, :n] = root @ root.T + 1e-3 * np.eye(n)
    return covariance


def random_step(rng, n_factors):
    """Blocks of a transition, some of them zero, derivatives by the factors, and both as F."""
    blocks = rng.normal(size=(*ROAD.neighbours.shape, 4))
    blocks[rng.random(blocks.shape[:2]) < 0.3] = 0.0
    by_factor, n = rng.normal(size=(n_factors, 3)), 2 * ROAD.n_segments
    dense = np.zeros((n + n_factors, n + n_factors))
    for c in range(ROAD.n_segments):
        for slot in range(ROAD.degree[c]):
            b = ROAD.neighbours[c, slot]
            dense[2 * c : 2 * c + 2, 2 * b : 2 * b + 2] = blocks[c, slot].reshape(2, 2)
    for e, c in enumerate(ROAD.entries[:n_factors]):
        dense[2 * c : 2 * c + 2, n + e] = by_factor[e, :2]
        dense[n + e, n + e] = by_factor[e, 2]
    return blocks, by_factor, dense


@pytest.mark.parametrize("n_factors", [0, 3])
def test_propagation_is_that_of_dense_matrices(n_factors):
    rng = np.random.default_rng(n_factors)
    blocks, by_factor, F = random_step(rng, n_factors)
    n = len(F)
    P, noise = random_covariance(rng, n), rng.uniform(0.1, 1.0, n)
    slopes, L = rng.normal(size=ROAD.n_segments), np.eye(n)
    psi = np.arange(1, 2 * ROAD.n_segments, 2)
    L[psi, psi - 1] = slopes
    expected, scratch = F @ P[:, :n] @ F.T + L * noise @ L.T, np.empty((2, *P.shape))
    out = np.where(np.arange(P.shape[1]) < n, np.full_like(P, np.nan), 0.0)
    propagate(ROAD, blocks, by_factor, noise, slopes, P, scratch, out)
    mirror(out)
    np.testing.assert_allclose(out[:, :n], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(out[:, :n], out[:, :n].T)
    np.testing.assert_array_equal(out[:, n:], 0.0)
    propagate(ROAD, blocks, by_factor, noise, slopes, P, scratch, P)
    mirror(P)
    np.testing.assert_array_equal(P, out)

    x, moved = rng.normal(size=n), np.empty(n)
    apply(ROAD, blocks, by_factor, n_factors, x, moved)
    np.testing.assert_allclose(moved, F @ x, rtol=1e-12, atol=1e-12)
    apply_transposed(ROAD, blocks, by_factor, n_factors, x, moved)
    np.testing.assert_allclose(moved, F.T @ x, rtol=1e-12, atol=1e-12)


def updated(covariance, rows, noise):
    """A covariance after rows (first component, derivatives), by one call each."""
    covariance, work = covariance.copy(), np.empty((4, WIDTH))
    for first, weights in rows:
        assert pair_update(covariance, first, weights, noise, work)
    mirror(covariance)
    return covariance[:, :N]


def joint_update(covariance, rows, noise):
    """The covariance after an update by all rows at once."""
    P, h = covariance[:, :N], np.zeros((2 * len(rows), N))
    for i, (first, weights) in enumerate(rows):
        h[2 * i : 2 * i + 2, first : first + weights.shape[1]] = weights
    S = h @ P @ h.T + np.diag(np.tile(noise, len(rows)))
    return P - P @ h.T @ np.linalg.solve(S, h @ P)


def test_updates_by_rows_in_any_order_are_one_by_all_of_them():
    """Rows of one segment, of several, and one that reaches the last component."""
    rng = np.random.default_rng(1)
    covariance, noise = random_covariance(rng), np.array([0.02, 0.05])
    places = [(6, 2), (6, 4), (0, 10), (N - 2, 2), (33, 8), (8, 2)]
    rows = [(first, rng.normal(size=(2, size))) for first, size in places]
    expected = joint_update(covariance, rows, noise)
    for order in (rows, rows[::-1]):
        found = updated(covariance, order, noise)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    # The second number's gain is that after the first one.
    first, weights = rows[0]
    work, P, gains = np.empty((4, WIDTH)), covariance[:, :N].copy(), np.empty((2, N))
    pair_update(covariance, first, weights, noise, work)
    for q, h in enumerate(weights):
        c = P[:, first : first + 2] @ h
        gains[q] = c / (h @ c[first : first + 2] + noise[q])
        P -= np.outer(gains[q], c)
    np.testing.assert_allclose(work[2:, :N], gains, rtol=1e-9, atol=1e-12)


def test_a_scalar_update_is_half_of_a_pair():
    rng = np.random.default_rng(2)
    covariance, column, gain = random_covariance(rng), np.empty(WIDTH), np.empty(WIDTH)
    weights, noise = rng.normal(size=(2, 4)), np.array([0.02, 0.05])
    P, one = covariance[:, :N].copy(), covariance.copy()
    for h, r in zip(weights, noise, strict=True):
        total = scalar_update(one, 7, h, r, column, gain)
        expected = h @ P[7:11, 7:11] @ h + r
        np.testing.assert_allclose(total, expected, rtol=1e-12)
        np.testing.assert_allclose(column[:N], P[:, 7:11] @ h, rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(gain[:N], P[:, 7:11] @ h / total, rtol=1e-10, atol=1e-14)
        P = one[:, :N].copy()
    both = updated(covariance, [(7, weights)], noise)
    np.testing.assert_allclose(one[:, :N], both, rtol=1e-9, atol=1e-13)


def test_joseph_form_makes_up_for_a_rounded_gain():
    """A precise number leaves a variance that is small beside the rounding of K c'."""
    noise = np.array([1.0, 3.0]) * 2.0**-40  # 1 + noise is exact
    expected = noise / (1.0 + noise)
    covariance = np.eye(N, WIDTH)
    assert pair_update(covariance, 4, np.eye(2), noise, np.empty((4, WIDTH)))
    np.testing.assert_allclose(np.diag(covariance)[4:6], expected, rtol=1e-12)
    covariance = 3.0 * np.eye(N, WIDTH)  # the second number of what the first has told precisely
    assert pair_update(covariance, 4, np.ones((2, 1)), noise, np.empty((4, WIDTH)))
    both = 1.0 / (1.0 / 3.0 + 1.0 / noise[0] + 1.0 / noise[1])
    np.testing.assert_allclose(covariance[4, 4], both, rtol=1e-12)
    covariance = np.eye(N, WIDTH)
    for i, (r, left) in enumerate(zip(noise, expected, strict=True)):
        scalar_update(covariance, i, np.ones(1), r, np.empty(WIDTH), np.empty(WIDTH))
        np.testing.assert_allclose(covariance[i, i], left, rtol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, -1e-4])  # noise makes up for the last
def test_what_is_no_variance_is_reported(bad):
    covariance = random_covariance(np.random.default_rng(3))
    covariance[4, 4] = bad
    assert not is_covariance(covariance, np.empty(WIDTH))
    assert not factor(covariance[:, :N].copy())
    before = covariance.copy()
    total = scalar_update(before, 4, np.ones(1), 1e-3, np.empty(WIDTH), np.empty(WIDTH))
    assert np.isnan(total)
    np.testing.assert_array_equal(before, covariance)
    assert not pair_update(covariance, 4, np.eye(2), np.full(2, 1e-3), np.empty((4, WIDTH)))


def test_a_correlation_above_one_is_no_covariance():
    good = random_covariance(np.random.default_rng(4))
    assert is_covariance(good, np.empty(WIDTH))
    for correlation in (np.nan, 1.001, -1.001):
        bad = good.copy()
        bad[7, 2] = bad[2, 7] = correlation * np.sqrt(good[7, 7] * good[2, 2])
        assert not is_covariance(bad, np.empty(WIDTH))


def test_factors_solve_and_products_are_numpys():
    rng = np.random.default_rng(5)
    P = random_covariance(rng)
    matrix, right, x = P[:, :N].copy(), rng.normal(size=(N, 5)), rng.normal(size=N)
    lower = matrix.copy()
    assert factor(lower)
    L = np.linalg.cholesky(matrix)
    np.testing.assert_allclose(np.tril(lower, -1), np.tril(L, -1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(1.0 / np.diag(lower), np.diag(L), rtol=1e-9)
    half, whole, one = right.copy(), right.copy(), x.copy()
    forward(lower, half)
    solve_many(lower, whole)
    solve(lower, one)
    np.testing.assert_allclose(L @ half, right, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(matrix @ whole, right, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(matrix @ one, x, rtol=1e-8, atol=1e-9)
    out = np.ones(WIDTH)
    add_product(P, x, out)
    np.testing.assert_allclose(out[:N], 1.0 + matrix @ x, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(out[N:], 1.0)


@pytest.mark.parametrize(("n_left", "n_right"), [(7, 4), (4, 7), (6, 5)])
def test_inner_products_are_numpys(n_left, n_right):
    rng = np.random.default_rng(6)
    left, right = rng.normal(size=(n_left, 24)), rng.normal(size=(n_right, 24))
    out = np.full((n_left, 8), np.nan)
    products(left, right, False, out)
    np.testing.assert_allclose(out[:, :n_right], left @ right.T, rtol=1e-12, atol=1e-12)
    assert np.isnan(out[:, n_right:]).all()
    products(left, left, True, square := np.full((n_left, n_left), np.nan))
    lower = np.tril_indices(n_left)
    np.testing.assert_allclose(square[lower], (left @ left.T)[lower], rtol=1e-12, atol=1e-12)
