"""Linear equations of a definite matrix against scipy's."""

import numpy as np
import pytest
from scipy.linalg import cho_solve, cholesky

from dptse_env.estimators.compiled.cholesky import solve
from tests.estimators.parts import compiled

solve = compiled(solve)


@pytest.mark.parametrize(("m", "columns"), [(1, 1), (2, 40), (3, 1), (4, 40), (5, 1), (38, 40)])
def test_solves_and_leaves_the_factor(m, columns):
    rng = np.random.default_rng(m)
    root, right = rng.normal(size=(m, m)), rng.normal(size=(m, columns))
    matrix = root @ root.T + np.eye(m)
    lower = cholesky(matrix, lower=True)
    expected = cho_solve((lower, True), right)
    # Only the lower half is read.
    given = np.tril(matrix) + np.triu(np.full((m, m), np.nan), 1)
    assert solve(given, right)
    np.testing.assert_allclose(right, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.tril(given, -1), np.tril(lower, -1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.diag(given), 1.0 / np.diag(lower), rtol=1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_says_when_a_matrix_is_not_definite(bad):
    matrix = np.eye(5)
    matrix[3, 3] = bad
    assert not solve(matrix, np.ones((5, 2)))
    joined = np.eye(5)
    joined[4, 0] = joined[0, 4] = 1.0 if np.isfinite(bad) else bad
    assert not solve(joined, np.ones((5, 2)))
