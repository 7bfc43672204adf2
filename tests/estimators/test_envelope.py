"""Matrices with entries near the diagonal, and the interior-point method on them."""

import numpy as np
import pytest

from dptse_env.estimators.compiled.envelope import (
    SPARE,
    close_envelope,
    factorise,
    invert,
    multiply,
    refactorise,
    solve,
    solve_many,
)
from dptse_env.estimators.compiled.interior_point import approach
from dptse_env.estimators.compiled.road_order import Space
from dptse_env.estimators.horizon import natural_residual
from dptse_env.estimators.horizon import solve as solve_by_library
from tests.cases import pairwise
from tests.estimators.parts import compiled

close_envelope = compiled(close_envelope)
factorise = compiled(factorise)
invert = compiled(invert)
multiply = compiled(multiply)
refactorise = compiled(refactorise)
solve = compiled(solve)
solve_many = compiled(solve_many)
approach = compiled(approach)

N, WIDTH = 120, 14


def random_space(seed=0, weakest=0.05):
    """A definite matrix with rows of many lengths, dense and as a space with its factor."""
    rng = np.random.default_rng(seed)
    first = np.maximum(np.arange(N) - rng.integers(0, WIDTH, N), 0)
    dense = np.zeros((N, N))
    for j in range(N):
        dense[first[j] : j, j] = rng.normal(size=j - first[j])
    dense += dense.T
    lift = weakest - np.linalg.eigvalsh(dense)[0]
    dense += lift * np.eye(N)
    last = np.zeros(N, np.int64)
    close_envelope(first, last)
    matrix, factor, inverse = np.zeros((3, N, WIDTH + SPARE))
    for i in range(N):
        matrix[i, : last[i] - i + 1] = dense[i, i : last[i] + 1]
    space = Space(
        matrix, factor, inverse, first, last, matrix[:, 0].copy(), np.ones((1, N)), np.ones(N),
        np.zeros(N, bool), np.zeros(N, np.int64), np.zeros(N), np.zeros(WIDTH + SPARE),
    )  # fmt: skip
    assert factorise(matrix, first, last, factor)
    return dense, space


def upper(space):
    """The factor as a dense matrix."""
    out = np.zeros((N, N))
    for i in range(N):
        out[i, i : space.last[i] + 1] = space.factor[i, : space.last[i] - i + 1]
    return out


def test_the_envelope_holds_every_entry_and_never_turns_back():
    dense, space = random_space()
    rows, columns = np.nonzero(dense)
    ahead = columns >= rows
    assert (space.last[rows[ahead]] >= columns[ahead]).all()
    assert (space.first[columns[ahead]] <= rows[ahead]).all()
    assert (np.diff(space.last) >= 0).all()
    assert (np.diff(space.first) >= 0).all()


def test_a_factor_solves_multiplies_and_inverts():
    dense, space = random_space()
    U = upper(space)
    np.testing.assert_allclose(U.T @ U, dense, atol=1e-12)
    x, right = np.random.default_rng(1).normal(size=(2, N))
    product = np.empty(N)
    multiply(space.matrix, space.last, x, product)
    np.testing.assert_allclose(product, dense @ x, atol=1e-12)
    out = right.copy()
    solve(space.factor, space.last, out)
    np.testing.assert_allclose(dense @ out, right, atol=1e-11)
    many = np.eye(N)[:, 7:9].copy()
    solve_many(space.factor, space.last, many)
    Z = np.linalg.inv(dense)
    np.testing.assert_allclose(many, Z[:, 7:9], atol=1e-11)
    invert(space.factor, space.last, space.inverse, space.row)
    for i in range(N):
        ours = space.inverse[i, : space.last[i] - i + 1]
        np.testing.assert_allclose(ours, Z[i, i : space.last[i] + 1], atol=1e-11)


def test_an_indefinite_matrix_has_no_factor():
    _, space = random_space()
    space.matrix[60, 0] = -1.0
    assert not factorise(space.matrix, space.first, space.last, space.factor)


def test_fixed_and_freed_variables_change_the_factor_alike_and_rows_above_are_left_alone():
    dense, space = random_space(weakest=1.0)
    rng = np.random.default_rng(2)
    for _ in range(20):
        changed = np.sort(rng.choice(N, size=rng.integers(1, 6), replace=False))
        space.free[changed] = 1.0 - space.free[changed]
        above = space.factor[: space.first[changed[0]]].copy()
        n_rows = refactorise(
            space.matrix, space.first, space.last, space.diagonal, space.free,
            changed, changed.size, space.factor, space.row,
        )  # fmt: skip
        assert 0 < n_rows <= N - space.first[changed[0]]
        np.testing.assert_array_equal(space.factor[: len(above)], above)
        free = space.free > 0.0
        expected = np.where(free[:, None] & free, dense, np.eye(N))
        U = upper(space)
        np.testing.assert_allclose(U.T @ U, expected, atol=1e-10)


def test_what_a_change_does_fades():
    """Far from it, no row is computed again."""
    dense, space = random_space(weakest=20.0)
    space.free[30] = 0.0
    n_rows = refactorise(
        space.matrix, space.first, space.last, space.diagonal, space.free,
        np.array([30]), 1, space.factor, space.row,
    )  # fmt: skip
    assert n_rows < 70
    U, fixed = upper(space), dense.copy()
    fixed[30], fixed[:, 30], fixed[30, 30] = 0.0, 0.0, 1.0
    np.testing.assert_allclose(U.T @ U, fixed, atol=1e-9)


@pytest.mark.parametrize(
    ("seed", "weakest", "part"), pairwise(range(4), [1.0, 1e-4], [(0, N), (25, 90)], n=4)
)
def test_the_interior_point_method_comes_near_another_solvers_minimum(seed, weakest, part):
    """Of a part of the variables, given the others; half of the bounds bind."""
    dense, space = random_space(seed, weakest)
    rng = np.random.default_rng(seed)
    q, low, high = 40.0 * rng.normal(size=N), np.zeros(N), np.full(N, 1.0)
    x = rng.random(N)
    before, (start, end) = x.copy(), part
    slope = dense @ x + q / 2
    rounds = approach(space, start, end, low, high, x, slope)
    assert 0 < rounds < 25
    outside = np.r_[:start, end:N]
    np.testing.assert_array_equal(x[outside], before[outside])
    inside = slice(start, end)
    H = dense[inside, inside]
    rest = q[inside] + 2.0 * dense[inside][:, outside] @ x[outside]
    best = solve_by_library(H, rest, low[inside], high[inside], "piqp")
    np.testing.assert_allclose(x[inside], best, atol=1e-4)
    assert natural_residual(H, rest, low[inside], high[inside], x[inside]) < 1e-6
    held = (x[inside] == 0.0) | (x[inside] == 1.0)
    assert held.sum() > (end - start) / 4
