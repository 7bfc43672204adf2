"""Localisation: where segments lie, and the function that covariances are weighed by."""

import numpy as np
import pytest

from dptse_env.estimators.localisation import gaspari_cohn, positions, row_tapers, tapers
from dptse_env.model import ARZModel, MeasurementRows, load_parameters
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


def model_with_rows(corridor, first, span):
    rows = MeasurementRows(np.array(first), np.array(span), corridor.n_segments)
    parameters = load_parameters("w99-3lane")
    return ARZModel(corridor, parameters, reference_speed=51.0, rows=rows, demand_states=True)


def test_a_rows_tapers_are_averages_of_its_segments():
    model = model_with_rows(SHORT_HIGHWAY, [1, 2], [1, 3])
    each, weights = tapers(SHORT_HIGHWAY, 0.3), row_tapers(model, 0.3)
    entries = [0, 6]  # the mainline's and the on-ramp
    single, wide = each[1], (each[2] + each[3] + each[4]) / 3.0
    for row, expected in zip(weights.with_states, (single, wide), strict=True):
        np.testing.assert_allclose(row[:16], np.repeat(expected, 2), rtol=1e-14)
        np.testing.assert_allclose(row[16:], expected[entries], rtol=1e-14)
    np.testing.assert_allclose(weights.among_rows[0], [1.0, wide[1]], rtol=1e-14)
    np.testing.assert_allclose(weights.among_rows[1], [wide[1], wide[2:5].mean()], rtol=1e-14)


def test_tapers_of_single_rows_are_those_of_the_segments():
    n = PAPER_HIGHWAY.n_segments
    weights = row_tapers(model_with_rows(PAPER_HIGHWAY, range(n), [1] * n), 0.35)
    each = tapers(PAPER_HIGHWAY, 0.35)
    np.testing.assert_array_equal(weights.among_rows, each)
    np.testing.assert_array_equal(weights.with_states[:, : 2 * n], np.repeat(each, 2, axis=1))


@pytest.mark.parametrize("reach", [0.05, 0.3, 2.0])
def test_tapers_of_rows_and_states_are_positive_semidefinite(reach):
    """Jointly with those among the components, at the segments and the factors' entries."""
    model = model_with_rows(PAPER_HIGHWAY, [0, 0, 1, 4, 8, 9, 12], [1, 2, 3, 5, 2, 3, 3])
    weights, each = row_tapers(model, reach), tapers(PAPER_HIGHWAY, reach)
    cells = np.concatenate([np.repeat(np.arange(19), 2), model.layout.entries])
    states = each[np.ix_(cells, cells)]
    joint = np.block([[states, weights.with_states.T], [weights.with_states, weights.among_rows]])
    np.testing.assert_allclose(joint, joint.T, atol=1e-15)
    assert np.linalg.eigvalsh(joint).min() > -1e-12
