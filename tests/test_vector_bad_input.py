import gymnasium as gym
import numpy as np
import pytest

from dptse_env.vector_env import SensorQueryVectorEnv

from .vectors import assert_same, short, staggered


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"num_envs": 0}, r"^num_envs must be an integer in 1\.\.1000000, got 0"),
        ({"num_envs": True}, r"^num_envs must be an integer in 1\.\.1000000, got True"),
        ({"autoreset_mode": "next"}, r"^autoreset_mode must"),
        ({"render_mode": "human"}, r"^render_mode must be None or 'rgb_array', got 'human'"),
        ({"render_episode": 3}, r"^render_episode must be an integer in 0\.\.1, got 3"),
        ({"threads": 0}, r"^threads must be an integer in 1\.\.1024, got 0"),
    ],
)
def test_bad_keywords_name_themselves(keywords, message):
    with pytest.raises(ValueError, match=message):
        SensorQueryVectorEnv(**{"num_envs": 2, "preset": "short-highway", **keywords})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"options": {"reset_mask": [True] * 3}}, r"reset_mask must be a bool array .*, got list"),
        ({"options": {"reset_mask": np.ones(2, bool)}}, r"reset_mask must"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, r"reset_mask must"),
        ({"options": {"start": [1, 2]}}, r"options\.start must"),
        ({"options": {"traffic_seed": [0, 1, 7]}}, r"options\.traffic_seed must be .*, got 7"),
        ({"seed": [1, 2]}, r"seed must be an integer or a list of 3, got 2"),
    ],
)
def test_bad_resets_are_refused_and_the_episodes_go_on(arguments, message):
    (env, actions), (undisturbed, _) = staggered(), staggered()
    with pytest.raises(ValueError, match=message):
        env.reset(**arguments)
    for _ in range(5):
        assert_same(env.step(actions), undisturbed.step(actions), tolerance=0)


@pytest.mark.parametrize(
    ("mode", "bad", "message"),
    [
        ("NextStep", np.zeros((2, 6), np.int8), r"actions must have shape \(3, 6\), got \(2, 6\)"),
        ("SameStep", np.zeros((3, 5), np.int8), r"action must have shape \(6,\)"),
        ("Disabled", np.full((3, 6), 2), r"action must hold 0 and 1 only"),
    ],
)
def test_bad_actions_are_refused_and_the_episodes_go_on(mode, bad, message):
    (env, actions), (undisturbed, _) = (staggered(autoreset_mode=mode) for _ in range(2))
    for _ in range(4):
        assert_same(env.step(actions), undisturbed.step(actions), tolerance=0)
    # Episode 1 is over now, or has just been begun again.
    if mode == "Disabled":
        for one in (env, undisturbed):
            one.reset(options={"reset_mask": np.array([False, True, False])})
    with pytest.raises(ValueError, match=message):
        env.step(bad)
    for _ in range(3 if mode == "Disabled" else 5):
        came_back = env.step(actions)
        assert_same(came_back, undisturbed.step(actions), tolerance=0)
        if mode == "Disabled" and came_back[3].any():
            break


def test_a_step_before_the_first_reset_is_refused():
    env = short()
    actions = np.zeros((3, 6), dtype=np.int8)
    with pytest.raises(gym.error.ResetNeeded, match="3 of 3 episodes were never reset"):
        env.step(actions)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(gym.error.ResetNeeded, match="2 of 3 episodes were never reset"):
        env.step(actions)
