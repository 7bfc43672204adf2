"""The recurrent network: both backends, and what it is given and gives."""

import dataclasses

import numpy as np
import pytest

from dptse_env.estimators import BACKENDS, make_estimator
from dptse_env.estimators.learned.network import LOWEST_SPREAD
from dptse_env.model.network import MeasurementRows

from ..episodes import RELEASES, random_streams, run, simulate, tell
from ..rows import averaged, update, with_rows
from .networks import random_network, settings


def started(backend, episodes, given):
    n = len(episodes.start)
    estimator = make_estimator("recurrent", backend, episodes.model, n, given)
    estimator.reset(episodes.everyone, episodes.start, random_streams(n))
    return estimator


def assert_agree(compiled, reference, tolerance=5e-6):
    """Agreement to some units in the last place of single precision."""
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        expected = getattr(b, field)
        np.testing.assert_allclose(
            getattr(a, field), expected, rtol=tolerance, atol=tolerance * np.abs(expected).max()
        )
    np.testing.assert_allclose(compiled.hidden, reference.hidden, atol=tolerance)
    np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-4)


@pytest.mark.parametrize("width", [8, 20])
@pytest.mark.parametrize("release", RELEASES)
def test_backends_agree(release, width, tmp_path):
    """Networks whose messages are all of the hidden state, or a part of it."""
    episodes = simulate(n=3, n_steps=80, release=release)
    given = settings(tmp_path, random_network(width))
    pair = [started(backend, episodes, given) for backend in BACKENDS]
    for k in range(80):
        for estimator in pair:
            estimator.predict(episodes.everyone, episodes.inputs[k])
        assert_agree(*pair)
        for estimator in pair:
            tell(
                estimator,
                episodes.everyone,
                episodes.observed[k],
                episodes.values[k],
                episodes.sigma,
            )
        assert_agree(*pair)
    assert np.abs(pair[0].hidden).max() > 0.5
    assert not pair[0].diverged.any()


def test_backends_agree_on_rows_that_overlap(tmp_path):
    episodes = averaged(60)
    pair = [started(backend, episodes, settings(tmp_path)) for backend in BACKENDS]
    for k in range(60):
        for estimator in pair:
            estimator.predict(episodes.everyone, episodes.inputs[k])
            update(estimator, episodes, k)
        assert_agree(*pair)


def test_episodes_do_not_depend_on_their_batch(tmp_path):
    episodes, given = simulate(n=5, n_steps=40), settings(tmp_path)
    together = started("compiled", episodes, given)
    run(together, episodes, range(40))
    alone = started("compiled", episodes, given)
    for k in range(40):
        for block in ([3, 1], [0], [4, 2]):
            rows = np.array(block)
            alone.predict(rows, episodes.inputs[k][rows])
            observed, values = episodes.observed[k][rows], episodes.values[k][rows]
            tell(alone, rows, observed, values, episodes.sigma)
    np.testing.assert_allclose(alone.hidden, together.hidden, atol=1e-6)
    np.testing.assert_allclose(alone.estimate().density, together.estimate().density, rtol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_prediction_is_what_was_said_of_the_next_second(backend, tmp_path):
    """A release changes the estimate of its second, and the prediction of the next."""
    episodes = simulate(n_steps=20)
    estimator = started(backend, episodes, settings(tmp_path))
    prior = estimator.estimate().density
    estimator.predict(episodes.everyone, episodes.inputs[0])
    np.testing.assert_array_equal(estimator.estimate().density, prior)
    args = episodes.observed[0], episodes.values[0], episodes.sigma
    tell(estimator, episodes.everyone, *args)
    after = estimator.estimate()
    assert np.abs(after.density - prior).min() > 0.0
    estimator.predict(episodes.everyone, episodes.inputs[1])
    assert np.abs(estimator.estimate().density - after.density).max() > 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_part_of_a_measurement_is_read(backend, tmp_path):
    episodes = averaged(1)
    given = settings(tmp_path)

    def estimated(values=0.0, sigma=1.0, centre=0.0, inputs=1.0):
        estimator = started(backend, episodes, given)
        estimator.predict(episodes.everyone, inputs * episodes.inputs[0])
        observed = np.zeros_like(episodes.observed[0])
        observed[0, 3] = observed[0, 25] = True
        tell(
            estimator,
            episodes.everyone,
            observed,
            episodes.values[0] + values,
            sigma * episodes.sigma[0],
            episodes.centre[0] + centre,
        )
        return estimator.estimate().density

    base = estimated()
    for change in ({"values": 5.0}, {"sigma": 2.0}, {"centre": 9.0}, {"inputs": 1.5}):
        assert np.abs(estimated(**change) - base).max() > 1e-4, change


@pytest.mark.parametrize("backend", BACKENDS)
def test_news_travel_from_cell_to_cell(backend, tmp_path):
    """One cell a second, in both directions and along ramps."""
    episodes = simulate(n_steps=1)
    pair = [started(backend, episodes, settings(tmp_path)) for _ in range(2)]
    n = episodes.model.n_segments
    sparsity = np.eye(n, dtype=bool)
    for start, end in episodes.model.layout.edges:
        sparsity[start, end] = sparsity[end, start] = True
    observed = np.zeros_like(episodes.observed[0])
    values = episodes.values[0].copy()
    reached = np.zeros(n, dtype=bool)
    reached[8] = True
    for second in range(4):
        for estimator, shift in zip(pair, (0.0, 30.0), strict=True):
            estimator.predict(episodes.everyone, episodes.inputs[0])
            observed[:] = False
            observed[0, 8] = second == 0
            tell(estimator, episodes.everyone, observed, values + shift, episodes.sigma)
        a, b = (estimator.estimate().density[0] for estimator in pair)
        np.testing.assert_array_equal(np.abs(a - b) > 1e-9, reached)
        reached = sparsity @ reached


@pytest.mark.parametrize("backend", BACKENDS)
def test_innovations_are_residuals_over_their_deviations(backend, tmp_path):
    episodes = averaged(3)
    estimator = started(backend, episodes, settings(tmp_path))
    for k in range(2):
        estimator.predict(episodes.everyone, episodes.inputs[k])
        update(estimator, episodes, k)
    estimator.predict(episodes.everyone, episodes.inputs[2])
    prior, m = estimator.estimate(), 21
    rows, observed = episodes.model.rows, np.zeros_like(episodes.observed[2])
    observed[0, m] = True
    update(estimator, episodes, 2, observed)
    covered = slice(rows.first[m], rows.first[m] + rows.span[m])
    assert rows.span[m] == 2
    rho, v = prior.density[0, covered], prior.speed[0, covered]
    slip = v - episodes.centre[2, 0, covered]
    values, sigma = episodes.values[2, 0, m], episodes.sigma[2, 0, m]
    variances = prior.density_std[0, covered] ** 2, prior.speed_std[0, covered] ** 2
    expected = [
        (values[0] - rho.mean()) / np.sqrt(variances[0].sum() / 4 + sigma[0] ** 2),
        (values[1] - (rho * slip).mean())
        / np.sqrt((rho**2 * variances[1] + slip**2 * variances[0]).sum() / 4 + sigma[1] ** 2),
    ]
    np.testing.assert_allclose(estimator.innovations[0, m], expected, rtol=1e-5)
    assert np.count_nonzero(estimator.innovations) == 2


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_releases_that_are_not_finite_reset_their_episode_alone(backend, bad, tmp_path):
    episodes = simulate(n=2, n_steps=6)
    estimator = started(backend, episodes, settings(tmp_path))
    run(estimator, episodes, range(5))
    values = episodes.values[5].copy()
    values[1, 14, 0] = bad
    estimator.predict(episodes.everyone, episodes.inputs[5])
    tell(estimator, episodes.everyone, episodes.observed[5], values, episodes.sigma)
    assert estimator.diverged.tolist() == [False, True]
    assert not estimator.hidden[1].any()
    assert not estimator.innovations[1].any()
    assert estimator.hidden[0].any()
    fresh = started(backend, episodes, settings(tmp_path))
    np.testing.assert_array_equal(estimator.estimate().density[1], fresh.estimate().density[1])


def test_deviations_and_estimates_stay_in_their_range(tmp_path):
    episodes = simulate(n_steps=30)
    network = random_network()
    network = network._replace(heads_bias=np.array([90, 90, -90, 90] * 2, dtype=np.float32))
    estimator = started("compiled", episodes, settings(tmp_path, network))
    run(estimator, episodes, range(30))
    estimate, unit = estimator.estimate(), estimator.cells.unit
    np.testing.assert_allclose(estimate.density[0], 4.0 * unit)
    np.testing.assert_allclose(estimate.speed, 1.1 * episodes.model.network.speed_limit)
    np.testing.assert_allclose(estimate.density_std[0], unit * np.exp(LOWEST_SPREAD))


def test_a_road_outside_of_the_card_is_refused_unless_asked(tmp_path):
    episodes = simulate(n_steps=1)
    given = settings(tmp_path, n_mainline=[3, 9])
    with pytest.raises(ValueError, match=r"trained on n_mainline in \[3, 9\].* has \[15, 15\]"):
        started("compiled", episodes, given)
    asked = dataclasses.replace(given.recurrent, outside=True)
    started("compiled", episodes, dataclasses.replace(given, recurrent=asked))
    model = with_rows(
        simulate(n_steps=1, release="flow").model,
        MeasurementRows(np.array([0]), np.array([4]), episodes.model.n_segments),
    )
    with pytest.raises(ValueError, match=r"trained on span in \[1, 3\], .* has \[4, 4\]"):
        make_estimator("recurrent", "compiled", model, 1, settings(tmp_path))
    with pytest.raises(ValueError, match=r"trained on flows in \[1, 1\]"):
        started("compiled", episodes, settings(tmp_path, flows=[1, 1]))
