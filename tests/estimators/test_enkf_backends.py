"""Both backends of the ensemble Kalman filter, each against the other."""

from dptse_env.estimators import Measurement
import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    EnsembleSettings,
    EstimatorSettings,
    make_estimator,
)
from tests.cases import pairwise

from .draws import draw_alike
from .episodes import RELEASES, SIGMA, random_streams, run, scale_of, simulate, started

FIELDS = ("density", "speed", "density_std", "speed_std")


OPTIONS = [
    {},
    {"inflation": 1.1},
    {"taper": 0.35},
    {"inflation": 1.1, "taper": 0.35, "n_members": 30},
]


@pytest.mark.parametrize(
    ("parameters", "bounds", "release", "options"),
    pairwise(["paper", "w99-3lane"], ["cone", "box"], RELEASES, OPTIONS),
)
def test_given_the_same_draws_backends_agree(parameters, bounds, release, options):
    episodes = simulate(parameters, n_steps=60, release=release)
    settings = EstimatorSettings(bounds=bounds, enkf=EnsembleSettings(**options))
    compiled, reference = (started("enkf", kind, episodes, settings) for kind in BACKENDS)
    draw_alike(compiled, reference)
    unit = scale_of(episodes.model)

    for k in range(60):
        for filters in (compiled, reference):
            run(filters, episodes, [k])
        np.testing.assert_allclose(compiled.members / unit, reference.members / unit, atol=1e-9)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-6)
        np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
        a, b = compiled.estimate(), reference.estimate()
        for field in FIELDS:
            np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)
        if bounds == "box":  # leaves psi / rho without a bound, and there rounding grows
            reference.members[:] = compiled.members


def test_backends_are_equal_in_distribution():
    """Estimates and what they claim, over 200 seeds each on the same traffic."""
    one, n = simulate(n_steps=10), 200
    everyone, drawn = np.arange(n), {}
    for backend in BACKENDS:
        filters = make_estimator("enkf", backend, one.model, n)
        filters.reset(everyone, np.repeat(one.start, n, axis=0), random_streams(n))
        drawn[backend] = []
        for k in range(10):
            filters.predict(everyone, np.repeat(one.inputs[k], n, axis=0))
            observed, values = (np.repeat(a[k], n, axis=0) for a in (one.observed, one.values))
            filters.update(everyone, Measurement.of(filters.model, observed, values, SIGMA))
            if k in (0, 4, 9):
                estimate = filters.estimate()
                drawn[backend].append([getattr(estimate, field) for field in FIELDS])
    a, b = (np.array(drawn[backend]) for backend in drawn)
    error = np.sqrt((a.var(axis=2, ddof=1) + b.var(axis=2, ddof=1)) / n)
    scores = (a.mean(axis=2) - b.mean(axis=2)) / error
    assert np.abs(scores).max() < 4.5
    assert np.sqrt(np.mean(scores**2)) < 1.3
    ratios = a.var(axis=2) / b.var(axis=2)  # each off by sqrt(2 / 200), about
    assert abs(np.log(ratios).mean()) < 0.1
    assert np.abs(np.log(ratios)).max() < 0.8
