import numpy as np

from .episodes import run, simulate, started


def test_is_the_model_and_nothing_else():
    episodes = simulate(n=2, n_steps=100)
    model, states = episodes.model, episodes.start
    alone = started("open_loop", "compiled", episodes)
    run(alone, episodes, range(100))
    for k in range(100):
        states = model.project(model.step(states, episodes.inputs[k]))
    estimate = alone.estimate()
    np.testing.assert_array_equal(estimate.density, model.density(states))
    np.testing.assert_allclose(estimate.speed, model.speed(states))
    np.testing.assert_array_equal(estimate.density_std, 0.0)
    np.testing.assert_array_equal(estimate.speed_std, 0.0)
    np.testing.assert_array_equal(alone.innovations, 0.0)


def test_backends_agree():
    episodes = simulate(n=2, n_steps=300)
    one, other = (started("open_loop", kind, episodes) for kind in ("compiled", "reference"))
    for alone in (one, other):
        run(alone, episodes, range(300))
    np.testing.assert_allclose(one.estimate().density, other.estimate().density, rtol=1e-9)
    np.testing.assert_allclose(one.estimate().speed, other.estimate().speed, rtol=1e-9)


def test_what_is_measured_means_nothing_to_it_whatever_it_is():
    speeds, flows = (simulate(n_steps=30, release=release) for release in ("speed", "flow"))
    one, other = (started("open_loop", "compiled", episodes) for episodes in (speeds, flows))
    run(one, speeds, range(30))
    run(other, flows, range(30))
    np.testing.assert_array_equal(one.states, other.states)
    np.testing.assert_array_equal(one.estimate().speed, other.estimate().speed)
