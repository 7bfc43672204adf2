import numpy as np

from dptse_env.estimators import make_estimator

from .episodes import SIGMA, random_streams, simulate


def test_is_the_model_and_nothing_else():
    episodes = simulate(n=2, n_steps=100)
    model, states = episodes.model, episodes.start
    alone = make_estimator("open_loop", "compiled", model, 2)
    alone.reset(episodes.everyone, states, random_streams(2))
    for k in range(100):
        alone.predict(episodes.everyone, episodes.inputs[k])
        alone.update(episodes.everyone, episodes.observed[k], episodes.values[k], SIGMA)
        states = model.project(model.step(states, episodes.inputs[k]))
    estimate = alone.estimate()
    np.testing.assert_array_equal(estimate.density, model.density(states))
    np.testing.assert_allclose(estimate.speed, model.speed(states))
    np.testing.assert_array_equal(estimate.density_std, 0.0)
    np.testing.assert_array_equal(alone.innovations, 0.0)


def test_backends_agree():
    episodes = simulate(n=2, n_steps=300)
    results = []
    for backend in ("compiled", "reference"):
        alone = make_estimator("open_loop", backend, episodes.model, 2)
        alone.reset(episodes.everyone, episodes.start, random_streams(2))
        for k in range(300):
            alone.predict(episodes.everyone, episodes.inputs[k])
        results.append(alone.estimate())
    np.testing.assert_allclose(results[0].density, results[1].density, rtol=1e-9)
    np.testing.assert_allclose(results[0].speed, results[1].speed, rtol=1e-9)


def test_a_state_that_is_none_goes_back_to_the_prior():
    episodes = simulate(n=2, n_steps=1)
    alone = make_estimator("open_loop", "reference", episodes.model, 2)
    alone.reset(episodes.everyone, episodes.start, random_streams(2))
    inputs = episodes.inputs[0].copy()
    inputs[1] = np.nan
    alone.predict(episodes.everyone, inputs)
    alone.update(episodes.everyone, episodes.observed[0], episodes.values[0], SIGMA)
    assert alone.diverged.tolist() == [False, True]
    np.testing.assert_allclose(alone.states[1], episodes.start[1], rtol=1e-12)
