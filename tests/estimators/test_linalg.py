"""The linear algebra that filters share, where rounding or what is no covariance decides.

All else of it is compared in filters: with their references, and with the Kalman filter.
"""

import numpy as np
import pytest

from dptse_env.estimators import linalg
from tests.helpers import compiled

factor, pair_update, scalar_update = map(
    compiled, (linalg.factor, linalg.pair_update, linalg.scalar_update)
)

N = 12
WIDTH = linalg.padded(N)


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
    covariance = np.eye(N, WIDTH)
    covariance[4, 4] = bad
    assert not factor(covariance[:, :N].copy())
    before = covariance.copy()
    total = scalar_update(before, 4, np.ones(1), 1e-3, np.empty(WIDTH), np.empty(WIDTH))
    assert np.isnan(total)
    np.testing.assert_array_equal(before, covariance)
    assert not pair_update(covariance, 4, np.eye(2), np.full(2, 1e-3), np.empty((4, WIDTH)))
