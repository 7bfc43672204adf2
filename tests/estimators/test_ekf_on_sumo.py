"""Both backends on a recorded simulation, and what the filter is worth there."""

import numpy as np
import pytest

from dptse_env.estimators import make_estimator
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY, RecordLibrary

from .episodes import FIXED_SENSORS, SIGMA, random_streams

SEGMENTS = 19


@pytest.fixture(scope="module")
def traffic(tmp_path_factory):
    """Density and speed of segments and boundary cells, `(K, 25)`; no speed where empty."""
    record = RecordLibrary(tmp_path_factory.mktemp("records")).get(PAPER_HIGHWAY, 3)
    counts, sums = record.counts, record.speed_sums
    speed = np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
    return counts / PAPER_HIGHWAY.segment_length, speed


def errors(name, backend, traffic, seed=0):
    """Density error from 60 s on, the estimator at the end, its largest variance on the way."""
    density, speed = traffic
    model = ARZModel(PAPER_HIGHWAY, load_parameters("w99-3lane"))
    estimator = make_estimator(name, backend, model, 1)
    start = model.states(20.0 * model.jam_density[None] / 400.0, np.full((1, SEGMENTS), 90.0))
    one, rng, squares, peak = np.arange(1), np.random.default_rng(seed), [], 0.0
    estimator.reset(one, start, random_streams(1))
    for k in range(1, len(density)):
        estimator.predict(
            one, model.boundary_inputs(density[k - 1 : k, SEGMENTS:], speed[k - 1 : k, SEGMENTS:])
        )
        observed = np.zeros((1, SEGMENTS), bool)
        observed[0, [*((3 * np.arange(5) + k) % 15), *FIXED_SENSORS]] = True
        seen = np.nan_to_num(speed[k, :SEGMENTS], nan=102.0)
        values = np.stack([density[k, :SEGMENTS], seen], -1)
        values = values + SIGMA * rng.normal(size=values.shape)
        estimator.update(one, observed, values[None], SIGMA)
        assert not estimator.diverged.any()
        if name == "ekf":
            peak = max(peak, estimator.covariances[0].diagonal().max())
        if k >= 60:
            squares.append((estimator.estimate().density[0, :15] - density[k, :15]) ** 2)
    return np.sqrt(np.mean(squares)), estimator, peak


def test_backends_agree_and_the_filter_beats_walk_and_model(traffic):
    compiled_error, compiled, _ = errors("ekf", "compiled", traffic)
    reference_error, reference, _ = errors("ekf", "reference", traffic)
    scale = np.tile([400.0, 400.0 * 140.0], SEGMENTS)
    np.testing.assert_allclose(compiled.states / scale, reference.states / scale, atol=1e-9)
    np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
    assert compiled_error == pytest.approx(reference_error, abs=1e-6)
    assert compiled_error < errors("random_walk", "compiled", traffic)[0]
    assert compiled_error < 0.7 * errors("open_loop", "compiled", traffic)[0]


def test_the_least_w_keeps_the_filter_sound(traffic, monkeypatch):
    """Without it, nearly empty and standing cells blow the covariance up."""
    error, _, peak = errors("ekf", "reference", traffic)
    assert peak < 100.0
    monkeypatch.setattr("dptse_env.model.arz.LEAST_W", 0.0)
    unsound_error, _, unsound_peak = errors("ekf", "reference", traffic)
    assert unsound_peak > 1e4
    assert unsound_error > error
