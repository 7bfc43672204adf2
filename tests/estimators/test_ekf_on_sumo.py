"""Both backends on a recorded simulation, and what the filter is worth there."""

import numpy as np
import pytest

from .episodes import RELEASES, run, scale_of, started


def errors(name, backend, episodes):
    """Density error from 60 s on, the estimator at the end, its largest variance on the way."""
    estimator, squares, peak = started(name, backend, episodes), [], 0.0
    density = episodes.model.density(episodes.truth)
    for k in range(len(episodes.inputs)):
        run(estimator, episodes, [k])
        assert not estimator.diverged.any()
        if name == "ekf":
            peak = max(peak, estimator.covariances[0].diagonal().max())
        if k >= 60:
            squares.append((estimator.estimate().density[0, :15] - density[k, 0, :15]) ** 2)
    return np.sqrt(np.mean(squares)), estimator, peak


@pytest.mark.parametrize("release", RELEASES)
def test_backends_agree_and_the_filter_beats_walk_and_model(release, recordings):
    recorded = recordings[release]
    compiled_error, compiled, _ = errors("ekf", "compiled", recorded)
    reference_error, reference, _ = errors("ekf", "reference", recorded)
    scale = scale_of(recorded.model)
    np.testing.assert_allclose(compiled.states / scale, reference.states / scale, atol=1e-9)
    np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
    assert compiled_error == pytest.approx(reference_error, abs=1e-6)
    assert compiled_error < errors("random_walk", "compiled", recorded)[0]
    assert compiled_error < 0.7 * errors("open_loop", "compiled", recorded)[0]


@pytest.mark.slow
def test_the_least_w_keeps_the_filter_sound(recorded, monkeypatch):
    """Without it, nearly empty and standing cells blow the covariance up."""
    error, _, peak = errors("ekf", "reference", recorded)
    assert peak < 100.0
    monkeypatch.setattr("dptse_env.model.model.LEAST_W", 0.0)
    unsound_error, _, unsound_peak = errors("ekf", "reference", recorded)
    assert unsound_peak > 1e4
    assert unsound_error > error
