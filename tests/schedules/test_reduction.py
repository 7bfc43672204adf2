import numpy as np
import pytest

from dptse_env.estimators import Estimate
from dptse_env.schedules import make_schedule

from .playing import begin, make_batch


@pytest.mark.parametrize("privacy", ["paper", "capped"])
@pytest.mark.parametrize("term", ["joint", "speed"])
def test_scores_are_the_expected_reduction_of_the_squared_error(privacy, term):
    env = make_batch(privacy=privacy, reward=term, bandwidth=1)
    observation = begin(env)
    process = env.unwrapped.process
    rng = np.random.default_rng(0)
    n, S = process.n_episodes, process.model.n_segments
    density, speed = rng.uniform(10.0, 90.0, (n, S)), rng.uniform(20.0, 90.0, (n, S))
    spread = rng.uniform(1.0, 40.0, (2, n, S))
    process.estimate = Estimate(density, speed, spread[0], spread[1])
    process.age = rng.integers(0, 20, process.age.shape)
    schedule = make_schedule("expected-reduction", env)
    action, _ = schedule.predict(observation)
    chosen = np.argmax(action, axis=1)

    corridor, sigma = process.config.corridor, process.release.sigma
    mainline = slice(0, corridor.n_mainline)
    P, Q = spread[0, :, mainline] ** 2, spread[1, :, mainline] ** 2
    noise = sigma[1] / density[:, mainline] if privacy == "capped" else sigma[1]
    parts = {
        "density": (P - 1.0 / (1.0 / P + 1.0 / sigma[0] ** 2)) / corridor.density_scale**2,
        "speed": (Q - 1.0 / (1.0 / Q + 1.0 / noise**2)) / corridor.speed_scale**2,
    }
    value = sum(part for name, part in parts.items() if term in ("joint", name))
    value = value * (process.age + 1.0)
    sensors = [s for s in corridor.fixed_sensors if s < corridor.n_mainline]
    value[:, sensors] = -1.0
    np.testing.assert_array_equal(chosen, np.argmax(value, axis=1))
