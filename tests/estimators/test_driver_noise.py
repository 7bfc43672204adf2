"""Process noise in (rho, w), and what it is as a noise in (rho, psi)."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import BACKENDS, DemandSettings, EnsembleSettings, EstimatorSettings
from tests.cases import pairwise

from .draws import draw_alike
from .episodes import run, scale_of, simulate, started
from .rows import averaged, update

IN_W = EstimatorSettings(process_noise=(0.02, 0.05), process_noise_in="w", density_growth=0.03)
RICH = replace(IN_W, count_noise=0.5, demand=DemandSettings())
QUIET = EstimatorSettings(process_noise=(0.0, 0.0))

both_backends = pytest.mark.parametrize("backend", BACKENDS)
both_bounds = pytest.mark.parametrize("bounds", ["cone", "box"])


def noise_around(model, before, after):
    """Q, normalised, of a step from a state `(n_x,)` to another one, of `IN_W`."""
    Q = np.zeros((2 * model.n_segments, 2 * model.n_segments))
    for s in range(model.n_segments):
        rho, psi = after[2 * s] / model.density_scale, after[2 * s + 1] / scale_of(model)[1]
        w = psi / rho
        a = 0.02**2 + 0.03**2 * before[2 * s] / model.density_scale
        pair = slice(2 * s, 2 * s + 2)
        Q[pair, pair] = [[a, w * a], [w * a, w * w * a + rho * rho * 0.05**2]]
    return Q


@pytest.mark.parametrize(
    ("name", "backend", "bounds"), pairwise(["ekf", "ukf"], BACKENDS, ["cone", "box"], n=4)
)
def test_q_is_that_of_independent_deviations_of_density_and_w(name, backend, bounds):
    """The UKF's points are made before Q is added, so that P differs by it there, too."""
    episodes = simulate(n_steps=1)
    noisy, quiet = (
        started(name, backend, episodes, replace(settings, bounds=bounds))
        for settings in (IN_W, QUIET)
    )
    before = noisy.states[0]
    for one in (noisy, quiet):
        one.predict(episodes.everyone, episodes.inputs[0])
    np.testing.assert_array_equal(noisy.states, quiet.states)
    expected = noise_around(episodes.model, before, noisy.states[0])
    found = noisy.covariances[0] - quiet.covariances[0]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-14)
    assert np.linalg.matrix_rank(expected) == 38


@pytest.mark.parametrize(
    ("name", "bounds", "settings"), pairwise(["ekf", "ukf"], ["cone", "box"], [IN_W, RICH], n=4)
)
def test_backends_agree(name, bounds, settings):
    """Each step begins at the same state: the UKF amplifies rounding, and so does the box."""
    episodes = averaged(30)
    settings = replace(settings, bounds=bounds)
    compiled, reference = (started(name, kind, episodes, settings) for kind in BACKENDS)
    one, scale = reference.filters[0], compiled.model.state_scale
    for k in range(30):
        one.x, one.P = compiled.states[0] / scale, compiled.covariances[0]
        for estimator in (compiled, reference):
            estimator.predict(episodes.everyone, episodes.inputs[k])
            update(estimator, episodes, k)
        again = ~episodes.observed[k] if k % 7 == 0 else None
        if again is not None:  # a second update in the same step
            for estimator in (compiled, reference):
                update(estimator, episodes, k, again)
        assert not np.any(compiled.diverged | reference.diverged)
        for a, b in (
            (compiled.states / scale, reference.states / scale),
            (compiled.covariances, reference.covariances),
            (compiled.innovations, reference.innovations),
        ):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@both_bounds
@pytest.mark.parametrize("settings", [IN_W, RICH], ids=["plain", "rich"])
def test_given_the_same_draws_ensembles_agree(bounds, settings):
    episodes = averaged(25)
    settings = replace(settings, bounds=bounds, enkf=EnsembleSettings(n_members=31))
    compiled, reference = (started("enkf", kind, episodes, settings) for kind in BACKENDS)
    draw_alike(compiled, reference)
    unit = compiled.model.state_scale
    for k in range(25):
        for estimator in (compiled, reference):
            estimator.predict(episodes.everyone, episodes.inputs[k])
            update(estimator, episodes, k)
        np.testing.assert_allclose(compiled.members / unit, reference.members / unit, atol=1e-9)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-6)
        if bounds == "box":  # leaves psi / rho without a bound, and there rounding grows
            reference.members[:] = compiled.members


@both_backends
def test_members_scatter_with_that_q(backend):
    """Members that begin as one: their sample covariance after a step is Q, as far as they tell."""
    n = 10_000
    few = replace(IN_W, process_noise=(2e-4, 5e-4), density_growth=3e-4, initial_variance=1e-16)
    settings = replace(few, enkf=EnsembleSettings(n_members=n))
    episodes = simulate(n_steps=1)
    enkf = started("enkf", backend, episodes, settings)
    before = episodes.start[0]
    enkf.predict(episodes.everyone, episodes.inputs[0])
    expected = 1e-4 * noise_around(episodes.model, before, enkf.states[0])
    deviation = np.sqrt(np.diag(expected))
    gap = (enkf.covariances[0] - expected) / np.outer(deviation, deviation)
    assert np.abs(gap).max() < 6.0 / np.sqrt(n)


@pytest.mark.parametrize("name", ["ekf", "ukf", "enkf"])
@both_backends
def test_an_empty_road_in_the_box_keeps_a_definite_covariance(name, backend):
    episodes = simulate(n=1, n_steps=6)
    settings = replace(IN_W, bounds="box")
    empty = started(name, backend, episodes, settings, np.zeros((1, 38)))
    closed = np.zeros_like(episodes.inputs)
    empty.predict(episodes.everyone, closed[0])
    assert np.isfinite(empty.covariances).all()
    if name == "ekf":
        np.testing.assert_array_equal(empty.states, 0.0)
        pairs = empty.covariances[0].reshape(19, 2, 19, 2)[np.arange(19), :, np.arange(19)]
        assert (np.linalg.eigvalsh(pairs) > 0.0).all()
        # What enters an empty segment drives at v_f.
        quiet = started(name, backend, episodes, replace(QUIET, bounds="box"), np.zeros((1, 38)))
        quiet.predict(episodes.everyone, closed[0])
        added = (empty.covariances - quiet.covariances)[0]
        np.testing.assert_allclose(added[0, :2], 0.02**2, rtol=1e-9)
    run(empty, episodes, range(1, 6))
    assert not empty.diverged.any()


@both_backends
def test_the_mhe_refuses_it_and_the_walk_does_not_read_it(backend):
    episodes = simulate(n_steps=2)
    message = r"^estimator_settings\.process_noise_in must be 'psi' for the MHE, got 'w'$"
    with pytest.raises(ValueError, match=message):
        started("mhe", backend, episodes, IN_W)
    one, other = (
        started("random_walk", backend, episodes, settings)
        for settings in (IN_W, replace(IN_W, process_noise_in="psi"))
    )
    for walk in (one, other):
        run(walk, episodes, range(2))
    np.testing.assert_array_equal(one.means, other.means)
