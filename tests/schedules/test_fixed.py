import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from dptse_env.config import resolve
from dptse_env.parts import make_interface
from dptse_env.schedules import Shifting, make_schedule


class Bare:
    """As much of an environment as a schedule needs."""

    def __init__(self, preset="paper-highway", **keywords):
        self.unwrapped = self
        self.interface = make_interface(resolve(preset, keywords))

    def observation(self, k=1, **blocks):
        observations = self.interface.observations
        flat = np.zeros((k, observations.space.shape[0]), dtype=np.float32)
        for name, values in blocks.items():
            flat[:, observations.slices[name]] = values
        return flat


def queried(name, n_steps, **keywords):
    """Return the segments that a schedule asks for over some steps."""
    env = Bare(**keywords)
    schedule, state, sets = make_schedule(name, env, seed=0), None, []
    for _ in range(n_steps):
        action, state = schedule.predict(env.observation()[0], state)
        sets.append(np.flatnonzero(action).tolist())
    return sets


def test_sets_start_as_far_apart_as_possible():
    for bandwidth in (5, 7, 11):
        (start,) = queried("static", 1, bandwidth=bandwidth)
        assert start == [15 * i // bandwidth for i in range(bandwidth)]


def test_the_paper_shifts_one_segment_every_four_steps():
    sets = queried("paper", 61)
    assert sets[:4] == [[0, 3, 6, 9, 12]] * 4
    assert sets[4:8] == [[1, 4, 7, 10, 13]] * 4
    assert sets[8] == [2, 5, 8, 11, 14]
    assert sets[12] == [0, 3, 6, 9, 12]
    assert sets[60] == sets[0]


def test_round_robin_shifts_every_step_and_static_never():
    assert queried("round-robin", 3) == [[0, 3, 6, 9, 12], [1, 4, 7, 10, 13], [2, 5, 8, 11, 14]]
    assert queried("static", 9) == [[0, 3, 6, 9, 12]] * 9


def test_random_draws_different_sets_of_full_size():
    sets = queried("random", 200)
    assert all(len(chosen) == 5 for chosen in sets)
    assert len({tuple(chosen) for chosen in sets}) > 150
    counts = np.bincount(np.concatenate(sets), minlength=15)
    assert counts.min() > 40
    assert queried("random", 5) == queried("random", 5)


def test_none_and_all():
    assert queried("none", 1) == [[]]
    assert queried("all", 1, bandwidth=15) == [list(range(15))]
    with pytest.raises(ValueError, match="'all' needs bandwidth 15, the environment has 5"):
        queried("all", 1)


def test_oldest_first_asks_the_oldest():
    env = Bare()
    age = np.linspace(0, 1, 15)[[3, 1, 14, 0, 2, 5, 4, 13, 12, 6, 7, 8, 11, 10, 9]]
    action, _ = make_schedule("oldest-first", env).predict(env.observation(age=age)[0])
    assert np.flatnonzero(action).tolist() == [2, 7, 8, 12, 13]


def test_oldest_first_asks_all_but_the_fixed_segment_equally_often():
    env = gym.make("dptse_env:dptse/PaperHighway-v0", traffic_seeds="0:1", estimator="random_walk")
    schedule, counts = make_schedule("oldest-first", env), np.zeros(15)
    observation, _ = env.reset(seed=0)
    state = None
    for _ in range(280):
        action, state = schedule.predict(observation, state)
        observation, *_, info = env.step(action)
        counts += info["queried"]
    assert counts[14] == 0
    np.testing.assert_allclose(counts[:14], 100, atol=3)


def test_a_batch_keeps_one_clock_per_episode():
    env = Bare()
    schedule = make_schedule("round-robin", env)
    _, state = schedule.predict(env.observation(2))
    action, _ = schedule.predict(env.observation(2), state, np.array([True, False]))
    assert [np.flatnonzero(row)[0] for row in action] == [0, 1]


def test_a_schedule_does_not_change_the_state_it_is_given():
    env = Bare()
    schedule = make_schedule("round-robin", env)
    _, state = schedule.predict(env.observation())
    copies = [part.copy() for part in state]
    schedule.predict(env.observation(), state, np.array([True]))
    for part, copy in zip(state, copies, strict=True):
        np.testing.assert_array_equal(part, copy)


def test_stable_baselines3_evaluates_a_schedule():
    env = gym.make("dptse_env:dptse/ShortHighway-v0", horizon=20, traffic_seeds="0:1")
    mean, _ = evaluate_policy(make_schedule("paper", env), env, n_eval_episodes=2, warn=False)
    assert mean < 0


def test_bad_schedules_are_named():
    with pytest.raises(ValueError, match=r"schedule must be one of none, .*oracle-.*, got 'best'"):
        make_schedule("best", Bare())
    with pytest.raises(ValueError, match=r"schedule\.period must be"):
        Shifting(Bare().interface, period=0)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("stale-variance", [1, 2, 12]), ("largest-deviation", [1, 5, 12])],
)
def test_deviations_are_weighed_by_age(name, expected):
    """Scores are (age + 1)^a (s_rho^2 + min(s_v, cap)^2), a = 2 with a cap of 0.1, or 1 without."""
    env = Bare(bandwidth=3)
    age = np.zeros(15)
    density, speed = np.full(15, 0.01), np.full(15, 0.01)
    age[1], density[1] = 8 / 60, 0.3  # far ahead under both
    age[2], density[2] = 24 / 60, 0.05  # 1.6 with the square of the age, 0.06 with the age
    density[12], speed[12] = 0.5, 0.1
    density[8] = 0.28  # between these two
    speed[5] = 1.5  # held to 0.1 under a cap
    blocks = {"age": age, "density_log_std": np.log(density), "speed_log_std": np.log(speed)}
    observation = env.observation(1, **{
        key: np.pad(value, (0, env.interface.observations.slices[key].stop
                            - env.interface.observations.slices[key].start - 15))
        for key, value in blocks.items()
    })  # fmt: skip
    action, _ = make_schedule(name, env).predict(observation[0])
    assert np.flatnonzero(action).tolist() == expected


def test_fronts_are_queried_where_answers_surprised():
    """Scores are (age + 1)^1.5 (|v_before - v_after| + 0.02) q (v + 0.3) (2 - x)."""
    env = Bare(bandwidth=2)
    speed = np.full(15, 1.0)
    speed[8:] = 0.4  # a front at 7 and 8, faster and upstream at 7
    blocks = {"speed": speed, "age": np.full(15, 0.1)}

    def observed(**more):
        padded = {
            key: np.pad(value, (0, env.interface.observations.slices[key].stop
                                - env.interface.observations.slices[key].start - 15))
            for key, value in {**blocks, **more}.items()
        }  # fmt: skip
        return env.observation(1, **padded)[0]

    schedule = make_schedule("speed-front", env)
    action, state = schedule.predict(observed())
    assert np.flatnonzero(action).tolist() == [7, 8]
    flags, surprise = np.zeros(15), np.zeros(15)
    flags[[2, 8]], surprise[2] = 1.0, 10.0
    answers = {"queried": flags, "density_innovation": surprise, "speed_innovation": surprise}
    for _ in range(3):  # surprised by 2, not by 8, of which no more is expected
        action, state = schedule.predict(observed(**answers), state)
    np.testing.assert_allclose(state.surprise[0, [2, 7, 8]], [0.512 + 48.8, 1.0, 0.512])
    assert np.flatnonzero(action).tolist() == [2, 7]
    action, state = schedule.predict(observed(), state, episode_start=[True])
    assert (state.surprise == 1.0).all()
    assert np.flatnonzero(action).tolist() == [7, 8]
