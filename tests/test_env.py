import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from dptse_env.config import EnvConfig
from dptse_env.env import SensorQueryEnv
from dptse_env.process import TRUTH_INFO
from dptse_env.registration import ENVIRONMENTS
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.utils.fields import field_hints
from tests.helpers import SHORT, assert_same, briefly, fast_and_slow, make_env, play

IDS = [f"dptse_env:{env_id}" for env_id in ENVIRONMENTS]
EVERY = sorted({(each, "mask") for each in IDS} | {(SHORT, name) for name in ACTION_ENCODINGS})
CHECKED = [(SHORT, "mask"), (SHORT, "sequential"), ("dptse_env:dptse/PrivateHighway-v1", "mask")]


@pytest.mark.parametrize(("env_id", "action"), fast_and_slow(EVERY, CHECKED))
def test_the_checkers_find_nothing(env_id, action):
    env = gym.make(env_id, action=action, traffic_seeds=[0], **briefly(env_id))
    check_env(env.unwrapped, skip_render_check=True)
    sb3_check_env(env.unwrapped)
    env.close()
    env.close()


@pytest.mark.slow
def test_importing_the_package_and_making_environments_is_light():
    code = """
import gymnasium as gym, sys, dptse_env
assert not {"libsumo", "numba", "torch", "matplotlib"} & set(sys.modules)
gym.make("dptse/PaperHighway-v0"), gym.make_vec("dptse/PaperHighway-v0", 4)
assert not {"libsumo", "torch", "stable_baselines3"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_seed_fixes_the_episodes_and_no_seed_goes_on():
    env = make_env()
    first = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    again = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    assert_same(first, again)
    assert_same(play(env, 30, seed=5), play(env, 30, seed=5))
    rewards = {tuple(step[1] for step in play(env, 30, seed=s)[1:]) for s in range(5)}
    assert len(rewards) == 5


def test_an_episode_ends_by_truncation_at_the_horizon():
    env = make_env(horizon=20)
    *_, before_last, last = play(env, 20)
    assert before_last[2:4] == (False, False)
    assert last[2:4] == (False, True)
    assert type(last[1]) is float
    assert type(last[2]) is bool
    assert type(last[3]) is bool
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        env.step(env.action_space.sample())


def test_sequential_actions_move_the_traffic_on_their_last_pick():
    env = make_env(action="sequential", bandwidth=3, horizon=5, truth_in_info=True)
    env.reset(seed=0)
    times, rewards, masks = [], [], []
    truncated = False
    while not truncated:
        free = env.unwrapped.action_masks()
        _, reward, _, truncated, info = env.step(np.flatnonzero(free)[0])
        times.append(info["truth"]["time"])
        rewards.append(reward)
        masks.append(int(free.sum()))
    assert times == [0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5]
    assert masks == [6, 5, 4] * 5
    assert [reward == 0 for reward in rewards] == [True, True, False] * 5


def test_info_has_the_same_finite_numbers_at_every_step():
    env = make_env()
    (_, at_reset), *steps = play(env, 30)
    assert at_reset.pop("privacy")["guarantee"] == "none"
    assert at_reset.pop("inherited") == []
    for info in [at_reset, *(step[4] for step in steps)]:
        assert info.keys() == at_reset.keys()
        flags = info.pop("queried")
        assert flags.dtype == bool
        assert flags.sum() <= 2
        for key, value in info.items():
            assert type(value) is float, key
            assert np.isfinite(value), key
        info["queried"] = flags


def test_truth_is_shown_only_on_request():
    assert "truth" not in make_env().reset(seed=0)[1]
    info = make_env(truth_in_info=True).reset(seed=0)[1]
    assert set(info["truth"]) == {"density", "speed", "traffic_seed", "time"}
    assert set(TRUTH_INFO) <= set(info)


def test_reset_options_choose_the_traffic_and_the_start():
    env = make_env(horizon=50, random_start=True, truth_in_info=True)
    truth = env.reset(seed=0, options={"traffic_seed": 2, "start": 100})[1]["truth"]
    assert (truth["traffic_seed"], truth["time"]) == (2, 100)
    starts = {env.reset()[1]["truth"]["time"] for _ in range(30)}
    assert len(starts) > 10
    assert max(starts) <= 190


def test_fixing_the_traffic_leaves_the_noise_as_it_was():
    env = make_env(traffic_seeds=[0])
    free = play(env, 10, seed=9)
    env.action_space.seed(9)
    fixed = [env.reset(seed=9, options={"traffic_seed": 0})]
    fixed += [env.step(env.action_space.sample()) for _ in range(10)]
    assert_same(free, fixed)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": 1}, r"options\.seed is unknown; allowed: traffic_seed, start"),
        ({"traffic_seed": 7}, r"options\.traffic_seed must be one of .* 3 traffic_seeds, got 7"),
        ({"start": 191}, r"options\.start must be an integer in 0\.\.190, got 191"),
        ({"start": 1.5}, r"options\.start must be an integer in 0\.\.190, got 1\.5"),
    ],
)
def test_bad_reset_options_are_refused_and_the_episode_goes_on(options, message):
    env, undisturbed = make_env(horizon=50), make_env(horizon=50)
    play(env, 3), play(undisturbed, 3)
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    action = np.zeros(6, dtype=np.int8)
    assert_same(env.step(action), undisturbed.step(action))


def test_a_pickled_environment_goes_on_where_it_was():
    env = make_env(render_mode="rgb_array")
    play(env, 10)
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(10):
        chosen = env.action_space.sample()
        assert_same(env.step(chosen), copy.step(chosen))
    assert_same(env.render(), copy.render())


def test_a_spec_survives_json():
    env = make_env(
        action="slots",
        privacy={"preset": "corrected", "epsilon": 5.0},
        corridor={"demand": {"mainline": [[0.0, 1500.0]], "on_ramps": [200.0]}},
        incident={"segment": 3, "phases": [[60.0, 120.0, 20.0]]},
        parameters={
            "name": "mine", "free_flow_speed": 120.0, "jam_density": 350.0, "gamma": 1.0,
            "relaxation_time": 40.0,
        },
        estimator_settings={"process_noise": [0.01, 0.01]},
    )  # fmt: skip
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    assert_same(play(env, 5), play(again, 5))


BAD = [
    ({"bandwith": 2}, "bandwith is unknown"),
    ({"bandwidth": 7}, "bandwidth must be"),
    ({"bandwidth": 2.5}, "bandwidth must be"),
    ({"estimator": "kf"}, "estimator must be one of"),
    ({"estimator": 3}, "estimator must be a class"),
    ({"backend": "gpu"}, "backend must be one of"),
    ({"action": "flags"}, "action must be one of"),
    ({"reward": 3}, "reward must be callable"),
    ({"observation": 3}, "observation must be"),
    ({"privacy": "none"}, r"privacy\.preset must be one of"),
    ({"privacy": {"sigma": 1.0}}, r"privacy\.sigma is unknown"),
    ({"privacy": {"preset": "capped", "cap": 2**63}}, r"privacy\.cap must be"),
    ({"privacy": 3}, "privacy must be"),
    ({"privacy": {"preset": [1]}}, r"privacy\.preset must be"),
    ({"epsilon": 1e-320}, r"privacy\.epsilon must be"),
    ({"epsilon": np.ones(2)}, r"privacy\.epsilon must be"),
    ({"corridor": 3}, "corridor must be"),
    ({"corridor": "long"}, "corridor must be one of"),
    ({"corridor": {"n_mainline": 2**63}}, r"corridor\.n_mainline must be"),
    ({"incident": "fog"}, "incident must be one of"),
    ({"render_every": 0}, "render_every must be"),
    ({"records": 1}, "records must be"),
    ({"estimator_settings": 3}, "estimator_settings must be"),
    ({"traffic_seeds": [-1]}, r"traffic_seeds\[0\] must be"),
    ({"traffic_seeds": "0:99999999999999"}, "traffic_seeds must be"),
    ({"traffic_seeds": []}, "traffic_seeds must be"),
    ({"traffic_seeds": "3:1"}, "traffic_seeds must be a range of seeds that is not empty"),
    ({"traffic_seeds": [1, 1]}, "traffic_seeds must be distinct"),
    ({"truth_in_info": 1}, "truth_in_info must be"),
    ({"penetration": 5e-324, "privacy": "paced"}, r"penetration\.share must be"),
    ({"horizon": 241}, "horizon must be"),
    ({"random_start": True}, "horizon must be below the record"),
    ({"parameters": 3}, "parameters must be"),
    ({"parameters": "fast"}, "parameters must be one of"),
    ({"estimator_settings": {},
      "parameters": {"name": "f", "free_flow_speed": 400.0, "jam_density": 300.0, "gamma": 1.0,
                     "relaxation_time": 50.0}}, r"corridor\.segment_length must be longer for"),
    ({"preset": "none"}, "preset must be one of"),
    ({"render_mode": "ansi"}, "render_mode must be"),
]  # fmt: skip


def nested(depth=100_000):
    """Return a list in a list in a list ..."""
    value = []
    for _ in range(depth):
        value = [value]
    return value


def test_values_that_are_nested_deeply_are_refused_by_their_path():
    deep = nested()
    values = dict.fromkeys(field_hints(EnvConfig), deep) | {
        "estimator_settings": {"mhe": {"solver": deep}},
        "privacy": {"preset": deep},
        "corridor": {"demand": {"mainline": deep}},
        "render_every": deep,
    }
    for key, value in values.items():
        with pytest.raises(ValueError, match=rf"^{key}\S* must .*\[\[\.\.\.\]\]"):
            gym.make(SHORT, **{key: value})


def test_bad_keywords_name_themselves():
    for keywords, message in BAD:
        with pytest.raises(ValueError, match=f"^{message}"):
            SensorQueryEnv(**{"preset": "short-highway", **keywords})
