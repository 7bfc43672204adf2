"""`SensorQueryEnv` in Gymnasium's terms: seeds, options, infos, specs, and bad keywords."""

import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from dptse_env.env import SensorQueryEnv
from dptse_env.process import TRUTH_INFO
from dptse_env.registration import ENVIRONMENTS
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.helpers import COUNTED, PAID, SHORT, assert_same, briefly, fast_and_slow, make_env, play

IDS = [f"dptse_env:{env_id}" for env_id in ENVIRONMENTS]
EVERY = sorted({(each, "mask") for each in IDS} | {(SHORT, name) for name in ACTION_ENCODINGS})
CHECKED = [case for case in EVERY if case[1] != "scores"]


@pytest.mark.parametrize(("env_id", "action"), fast_and_slow(EVERY, CHECKED))
def test_the_checkers_find_nothing(env_id, action):  # a warning is an error, too
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
assert not {"filterpy", "libsumo", "torch", "stable_baselines3"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_seed_fixes_the_episodes_and_no_seed_goes_on():
    env = make_env()
    first = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    again = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    assert_same(first, again)
    assert_same(play(env, 30, seed=5), play(env, 30, seed=5))
    env.step(np.ones(6, dtype=np.int8))
    assert_same(play(env, 5, seed=5), play(make_env(), 5, seed=5))  # nothing is left of an episode
    assert len({tuple(step[1] for step in play(env, 30, seed=s)[1:]) for s in range(5)}) == 5


def test_an_episode_ends_by_truncation_at_the_horizon():
    env = make_env(horizon=20)
    *_, before_last, last = play(env, 20)
    assert before_last[2:4] == (False, False)
    assert last[2:4] == (False, True)
    assert [type(value) for value in last[1:4]] == [float, bool, bool]
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        env.step(env.action_space.sample())


EVERY_INFO = [
    {},
    {"truth_in_info": True, "privacy": COUNTED},
    {"privacy": PAID, "action": "sequential"},
    {"privacy": "paced", "epsilon": 5, "query_every": 4, "penetration": 0.5},
]


@pytest.mark.parametrize("keywords", EVERY_INFO)
def test_info_has_the_same_flat_finite_numbers_at_the_reset_and_every_step(keywords):
    (_, at_reset), *steps = play(make_env(**keywords), 30)
    for info in [at_reset, *(step[4] for step in steps)]:
        assert info.keys() == at_reset.keys()
        assert type(info["traffic_seed"]) is int
        assert info["queried"].dtype == bool
        for key, value in info.items():
            array = np.asarray(value)
            assert np.isfinite(array).all()
            assert (array.shape, array.dtype) == (
                np.shape(at_reset[key]),
                np.asarray(at_reset[key]).dtype,
            )
            assert isinstance(value, np.ndarray) or type(value) in (int, float)


def test_truth_is_shown_only_on_request():
    assert not {"true_density", "true_speed", "time"} & {*make_env().reset(seed=0)[1]}
    info = make_env(truth_in_info=True).reset(seed=0)[1]
    assert set(TRUTH_INFO) <= set(info)
    assert info["true_density"].shape == info["true_speed"].shape == (8,)


def test_reset_options_choose_the_traffic_and_the_start_and_leave_the_rest():
    env = make_env(horizon=50, random_start=True, truth_in_info=True)
    info = env.reset(seed=0, options={"traffic_seed": 2, "start": 100})[1]
    assert (info["traffic_seed"], info["time"]) == (2, 100)
    assert env.step(env.action_space.sample())[4]["traffic_seed"] == 2
    starts = {env.reset()[1]["time"] for _ in range(30)}
    assert len(starts) > 10
    assert max(starts) <= 190
    free = play(env, 10, seed=9)
    env.action_space.seed(9)  # and with the traffic chosen, start and noise are as they were
    chosen = {"traffic_seed": free[0][1]["traffic_seed"]}
    fixed = [env.reset(seed=9, options=chosen)]
    assert_same(free, fixed + [env.step(env.action_space.sample()) for _ in range(10)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": 1}, "seed is unknown; allowed: traffic_seed, start"),
        ({"traffic_seed": 7}, "traffic_seed must .*, got 7"),
        ({"start": 191}, r"start must .* 0\.\.190, got 191"),
        ({"start": 1.5}, r"start must .* 0\.\.190, got 1\.5"),
    ],
)
def test_bad_reset_options_are_refused_and_the_episode_goes_on(options, message):
    env, undisturbed = make_env(horizon=50), make_env(horizon=50)
    play(env, 3), play(undisturbed, 3)
    with pytest.raises(ValueError, match=rf"options\.{message}"):
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


BAD = {
    "bandwith is unknown": {"bandwith": 2},
    r"unit is unknown; it is a field of privacy, privacy=.*; allowed: ": {"unit": "event"},
    "bandwidth must be": {"bandwidth": 2.5},
    "estimator must be one of": {"estimator": "kf"},
    "estimator must be a subclass": {"estimator": 3},
    "backend must be one of": {"backend": "gpu"},
    "action must be one of": {"action": "flags"},
    "reward must be callable": {"reward": 3},
    "observation must be": {"observation": 3},
    r"privacy\.preset must be one of": {"privacy": "none"},
    r"privacy\.sigma is unknown": {"privacy": {"sigma": 1.0}},
    r"privacy\.cap must be": {"privacy": {"preset": "capped", "cap": 2**63}},
    "privacy must be": {"privacy": 3},
    r"privacy\.preset must be": {"privacy": {"preset": [1]}},
    r"privacy\.epsilon must be": {"epsilon": 1e-320},
    "corridor must be": {"corridor": 3},
    "corridor must be one of": {"corridor": "long"},
    r"corridor\.n_mainline must be": {"corridor": {"n_mainline": 2**63}},
    r"corridor\.incident must be one of": {"incident": "fog"},
    "render_every must be": {"render_every": 0},
    "render_mode must be": {"render_mode": "ansi"},
    "records must be": {"records": 1},
    "estimator_settings must be": {"estimator_settings": 3},
    r"traffic_seeds\[0\] must be": {"traffic_seeds": [-1]},
    r"traffic_seeds must be 1 to \d+ seeds": {"traffic_seeds": []},
    "traffic_seeds must be a range of seeds that is not empty": {"traffic_seeds": "3:1"},
    "traffic_seeds must be distinct": {"traffic_seeds": [1, 1]},
    "truth_in_info must be": {"truth_in_info": 1},
    r"penetration\.share must be": {"penetration": 5e-324, "privacy": "paced"},
    "horizon must be": {"horizon": 241},
    r"query_every must be an integer in 1\.\.3600, got 0": {"query_every": 0},
    r"query_every must be an integer in 1\.\.3600, got 1\.5": {"query_every": 1.5},
    "query_every must be at most the 60 s of an episode": {"query_every": 61, "horizon": 60},
    r"horizon must be in 1\.\.239, shorter than the record": {"random_start": True},
    "parameters must be one of": {"parameters": "fast"},
    r"corridor\.segment_length must be at least": {
        "estimator_settings": {},
        "parameters": {"name": "f", "free_flow_speed": 400.0, "jam_density": 300.0, "gamma": 1.0,
                       "relaxation_time": 50.0},
    },
    "preset must be one of": {"preset": "none"},
}  # fmt: skip


def test_bad_keywords_name_themselves():
    for message, keywords in BAD.items():
        with pytest.raises(ValueError, match=f"^{message}"):
            SensorQueryEnv(**{"preset": "short-plain", **keywords})
