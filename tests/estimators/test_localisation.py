"""Localisation: where segments lie, and the function that covariances are weighed by."""

import numpy as np
import pytest

from dptse_env.estimators.localisation import gaspari_cohn, positions, tapers
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY


def test_ramps_lie_at_the_face_where_they_join():
    x = positions(SHORT_HIGHWAY)  # on-ramp at face 2, off-ramp at face 4, segments of 0.1 km
    np.testing.assert_allclose(x, [0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.2, 0.4])


def test_gaspari_cohn_is_a_convolution_of_tents():
    """Eq. 4.10 is the self-convolution over space of a tent of half the reach, normalised."""
    # In three dimensions, along an axis: integrate tent(|r|) tent(|r - d|) over cylinders.
    half, step = 0.5, 0.01
    z = np.arange(-0.5 + step / 2, 1.5, step)
    radius = np.arange(step / 2, 0.5, step)
    z, radius = np.meshgrid(z, radius)

    def overlap(distance):
        tent = np.maximum(0.0, 1.0 - np.hypot(z, radius) / half)
        other = np.maximum(0.0, 1.0 - np.hypot(z - distance, radius) / half)
        return np.sum(tent * other * radius)

    distances = np.linspace(0.0, 1.0, 11)
    expected = [overlap(d) / overlap(0.0) for d in distances]
    np.testing.assert_allclose(gaspari_cohn(distances, 1.0), expected, atol=2e-3)


def test_gaspari_cohn_falls_smoothly_to_zero_at_its_reach():
    x = np.linspace(0.0, 3.0, 3001)
    weights = gaspari_cohn(x, 2.0)
    assert weights[0] == 1.0
    assert gaspari_cohn(np.array([1.0]), 2.0)[0] == pytest.approx(5.0 / 24.0, rel=1e-12)
    np.testing.assert_array_equal(weights[x >= 2.0], 0.0)
    assert (np.diff(weights) <= 0.0).all()
    assert np.abs(np.diff(weights, 2)).max() < 1e-5  # no kink where the pieces meet


@pytest.mark.parametrize("corridor", [PAPER_HIGHWAY, SHORT_HIGHWAY])
@pytest.mark.parametrize("reach", [0.05, 0.3, 2.0])
def test_tapers_are_correlations(corridor, reach):
    weights = tapers(corridor, reach)
    assert weights.shape == (corridor.n_segments,) * 2
    np.testing.assert_array_equal(weights, weights.T)
    np.testing.assert_array_equal(np.diag(weights), 1.0)
    assert np.linalg.eigvalsh(weights).min() > -1e-12
