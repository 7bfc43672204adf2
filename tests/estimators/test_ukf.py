"""Both backends of the unscented Kalman filter, and each against the other."""

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints

from dptse_env.estimators import EstimatorSettings, SigmaPointSettings
from dptse_env.estimators.ukf import UKF
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY
from tests.helpers import pairwise

from .episodes import RELEASES, SIGMA, run, scale_of, simulate, started, tell

BACKENDS = ("compiled", "reference")
both_releases = pytest.mark.parametrize("release", RELEASES)


def step_together(episodes, settings, **tolerance):
    """Start both backends anew from one filter's state each step: rounding is not compared.

    The filter amplifies it, the reference against itself as well.
    """
    compiled, reference = (
        started("ukf", kind, episodes, settings) for kind in ("compiled", "reference")
    )
    one, scale = reference.filters[0], scale_of(episodes.model)
    for k in range(len(episodes.inputs)):
        one.x, one.P = compiled.states[0] / scale, compiled.covariances[0]
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        np.testing.assert_allclose(compiled.states / scale, reference.states / scale, **tolerance)
        np.testing.assert_allclose(compiled.covariances, reference.covariances, **tolerance)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, **tolerance)
        assert not np.any(compiled.diverged | reference.diverged)
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("parameters", "bounds", "release"),
    pairwise(["paper", "w99-3lane"], ["cone", "box"], RELEASES, n=4),
)
def test_backends_take_the_same_step_from_every_state_of_an_episode(parameters, bounds, release):
    # In the box w has no bound: points that break the CFL condition blow up rounding.
    tolerance = {"rtol": 0.0, "atol": 1e-9} if bounds == "cone" else {"rtol": 1e-6, "atol": 1e-6}
    episodes = simulate(parameters, n_steps=250, release=release)
    step_together(episodes, EstimatorSettings(bounds=bounds), **tolerance)


@both_releases
def test_backends_take_the_same_step_from_every_state_of_a_recorded_episode(release, recordings):
    step_together(recordings[release], EstimatorSettings(), rtol=0.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("release", "tolerance"), [("speed", 1e-7), ("flow", 1e-9)])
def test_backends_agree_over_a_recorded_episode_where_rounding_dies_out(
    release, tolerance, recordings
):
    """At alpha 0.3 it does; with speeds it grows on the way, even between two references."""
    episodes = recordings[release]
    settings = EstimatorSettings(ukf=SigmaPointSettings(alpha=0.3))
    compiled, reference = (started("ukf", kind, episodes, settings) for kind in BACKENDS)
    scale = scale_of(episodes.model)
    for k in range(len(episodes.inputs)):
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        gap = np.abs(compiled.states - reference.states) / scale
        assert gap.max() <= tolerance, (k, gap.max())
        assert not np.any(compiled.diverged | reference.diverged)
    np.testing.assert_allclose(compiled.covariances, reference.covariances, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(compiled.innovations, reference.innovations, rtol=0.0, atol=1e-9)


def test_the_number_of_outputs_may_change():
    episodes = simulate(n_steps=40)
    rng = np.random.default_rng(0)
    episodes.observed[:] = rng.random(episodes.observed.shape) < rng.random((40, 1, 1))
    counts = episodes.observed.sum(axis=2)
    assert counts.min() <= 2
    assert counts.max() >= 17
    step_together(episodes, EstimatorSettings(), rtol=0.0, atol=1e-9)


def test_weights_are_the_papers():
    ukf = UKF(ARZModel(PAPER_HIGHWAY, load_parameters("paper")), 1, EstimatorSettings())
    points = ukf._points
    peer = MerweScaledSigmaPoints(38, alpha=0.1, beta=2.0, kappa=-4.0)
    assert peer.Wm[0] == pytest.approx(-110.765, abs=1e-3)
    assert peer.Wc[0] == pytest.approx(-107.775, abs=1e-3)
    assert points.weight == pytest.approx(peer.Wm[1], rel=1e-12)
    assert points.weight == pytest.approx(1.4706, abs=1e-4)
    # Sum d d' of all weights, written around the first point instead of the mean.
    assert points.surplus == pytest.approx(peer.Wc[0] - peer.Wm[0] - 1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("backend", "poison"),
    pairwise(["compiled", "reference"], [np.nan, np.inf, -1.0, "indefinite"], rest=False),
)
def test_a_broken_covariance_is_found(backend, poison):
    episodes = simulate(n_steps=5)
    filters = started("ukf", backend, episodes)
    run(filters, episodes, range(3))
    kept = filters.filters.covariances if backend == "compiled" else filters.filters[0].P[None]
    if poison == "indefinite":
        kept[0, 20, 4] = kept[0, 4, 20] = 10.0
    else:
        kept[0, 20, 20] = poison
    tell(filters, episodes.everyone, episodes.observed[4], episodes.values[4], SIGMA)
    assert filters.diverged.tolist() == [True]
    np.testing.assert_array_equal(filters.covariances[0], 1e-3 * np.eye(38))
