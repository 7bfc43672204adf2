"""The compiled linear algebra against dense numpy."""

import numpy as np
import pytest

from dptse_env.estimators.compiled.algebra import (
    is_covariance,
    mirror,
    padded,
    propagate,
    scratch_vectors,
    segment_update,
    sum_update,
)
from dptse_env.model import ARZModel
from dptse_env.model.parameters import load_parameters
from dptse_env.traffic import PAPER_HIGHWAY
from tests.estimators.parts import compiled

is_covariance = compiled(is_covariance)
mirror = compiled(mirror)
propagate = compiled(propagate)
scratch_vectors = compiled(scratch_vectors)
segment_update = compiled(segment_update)
sum_update = compiled(sum_update)

MODEL = ARZModel(PAPER_HIGHWAY, load_parameters("paper"))
N = MODEL.n_states


def random_covariance(rng):
    root = rng.normal(size=(N, N)) * 0.1
    covariance = np.zeros((N, padded(N)))
    covariance[:, :N] = root @ root.T + 1e-3 * np.eye(N)
    return covariance


def test_padding_is_whole_registers():
    assert [padded(n) for n in (1, 8, 38, 40)] == [8, 8, 40, 40]


def test_propagation_is_f_p_f_transposed_plus_q():
    rng = np.random.default_rng(0)
    road = MODEL.road
    blocks = rng.normal(size=(*road.neighbours.shape, 4))
    blocks[rng.random(blocks.shape[:2]) < 0.3] = 0.0
    dense = np.zeros((N, N))
    for c in range(MODEL.n_segments):
        for slot in range(road.degree[c]):
            b = road.neighbours[c, slot]
            dense[2 * c : 2 * c + 2, 2 * b : 2 * b + 2] = blocks[c, slot].reshape(2, 2)
    covariance = random_covariance(rng)
    noise = np.array([0.3, 0.7])
    expected = dense @ covariance[:, :N] @ dense.T + np.diag(np.tile(noise, N // 2))
    scratch = np.zeros((2, *covariance.shape))
    no_factors = np.empty((0, 2))
    propagate(road, blocks, no_factors, np.tile(noise, N // 2), covariance, *scratch)
    np.testing.assert_allclose(covariance[:, :N], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(covariance[:, :N], covariance[:, :N].T)
    np.testing.assert_array_equal(covariance[:, N:], 0.0)


def test_propagation_with_demand_states_adds_their_columns():
    rng = np.random.default_rng(1)
    road, n_factors = MODEL.road, MODEL.road.entries.size
    n = N + n_factors
    blocks = rng.normal(size=(*road.neighbours.shape, 4))
    by_factor = rng.normal(size=(n_factors, 2))
    dense = np.zeros((n, n))
    for c in range(MODEL.n_segments):
        for slot in range(road.degree[c]):
            b = road.neighbours[c, slot]
            dense[2 * c : 2 * c + 2, 2 * b : 2 * b + 2] = blocks[c, slot].reshape(2, 2)
    for e, c in enumerate(road.entries):
        dense[2 * c : 2 * c + 2, N + e] = by_factor[e]
        dense[N + e, N + e] = 1.0
    root = 0.1 * rng.normal(size=(n, n))
    covariance = np.zeros((n, padded(n)))
    covariance[:, :n] = root @ root.T + 1e-3 * np.eye(n)
    noise = rng.uniform(0.1, 1.0, n)
    expected = dense @ covariance[:, :n] @ dense.T + np.diag(noise)
    propagate(road, blocks, by_factor, noise, covariance, *np.zeros((2, *covariance.shape)))
    np.testing.assert_allclose(covariance[:, :n], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(covariance[:, n:], 0.0)


@pytest.mark.parametrize(("first", "span"), [(3, 1), (3, 2), (0, 5), (17, 2)])
def test_the_average_of_segments_is_two_scalar_updates(first, span):
    rng = np.random.default_rng(2)
    covariance, residuals = random_covariance(rng), rng.normal(size=2)
    slopes, noise = rng.normal(size=(MODEL.n_segments, 2)), np.array([0.03, 0.2])
    H = np.zeros((2, N))
    for s in range(first, first + span):
        H[0, 2 * s] = 1.0 / span
        H[1, 2 * s : 2 * s + 2] = slopes[s] / span
    P = covariance[:, :N].copy()
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(noise))
    shift = np.zeros(padded(N))
    work = scratch_vectors(padded(N))
    assert sum_update(covariance, first, span, residuals, slopes, noise, shift, work)
    mirror(covariance)
    np.testing.assert_allclose(shift[:N], gain @ residuals, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(covariance[:, :N], P - gain @ H @ P, rtol=1e-9, atol=1e-12)


def updated(covariance, segments, rows, noise):
    covariance, shift = covariance.copy(), np.zeros(padded(N))
    work = scratch_vectors(padded(N))
    for segment in segments:
        assert segment_update(covariance, segment, rows[segment], noise, shift, work)
    mirror(covariance)
    return shift[:N], covariance[:, :N]


def test_sequential_updates_equal_one_by_all_rows_in_any_order():
    rng = np.random.default_rng(1)
    covariance, rows = random_covariance(rng), rng.normal(size=(MODEL.n_segments, 4))
    noise = np.array([0.02, 0.05])
    segments = [3, 17, 0, 8, 12, 18]
    shift, after = updated(covariance, segments, rows, noise)

    h = np.zeros((2 * len(segments), N))
    for i, s in enumerate(segments):
        h[2 * i, 2 * s] = 1.0
        h[2 * i + 1, 2 * s : 2 * s + 2] = rows[s, 2:]
    p = covariance[:, :N]
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + np.diag(np.tile(noise, len(segments))))
    residual = rows[segments, :2].ravel()
    np.testing.assert_allclose(shift, gain @ residual, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(after, p - gain @ h @ p, rtol=1e-9, atol=1e-11)

    other_shift, other = updated(covariance, segments[::-1], rows, noise)
    np.testing.assert_allclose(other_shift, shift, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(other, after, rtol=1e-10, atol=1e-12)


def test_precise_measurements_leave_a_positive_definite_covariance():
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(MODEL.n_segments, 4))
    _, after = updated(random_covariance(rng), range(19), rows, np.array([1e-10, 1e-10]))
    assert np.linalg.eigvalsh(after).min() > -1e-14


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_a_predicted_variance_that_is_none_is_reported(bad):
    covariance = random_covariance(np.random.default_rng(3))
    covariance[4, 4] = bad
    arguments = np.ones(4), np.array([1e-3, 1e-3]), np.zeros(padded(N)), scratch_vectors(padded(N))
    assert not segment_update(covariance, 2, *arguments)


def test_what_is_no_covariance_is_recognised():
    good = random_covariance(np.random.default_rng(4))
    assert is_covariance(good, np.zeros(padded(N)))
    for i, j, value in ((5, 5, -1.0), (5, 5, np.inf), (7, 2, np.nan), (7, 2, 1e3)):
        bad = good.copy()
        bad[i, j] = bad[j, i] = value
        assert not is_covariance(bad, np.zeros(padded(N)))
