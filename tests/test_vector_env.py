import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from dptse_env.actions import ACTION_ENCODINGS
from dptse_env.estimators import ESTIMATORS
from dptse_env.registration import ENVIRONMENTS
from dptse_env.vector_env import SensorQueryVectorEnv

SHORT = "dptse_env:dptse/ShortHighway-v0"
MODES = [mode.value for mode in AutoresetMode]
COUNTED = {"preset": "guaranteed", "cap": 5, "boundary_inputs": "private"}


EPISODES = {"traffic_seeds": "0:3", "horizon": 6, "random_start": True}


def short(num_envs=3, **keywords):
    return gym.make_vec(SHORT, num_envs=num_envs, **{**EPISODES, **keywords})


def assert_same(first, second, tolerance=1e-10):
    """Compare everything that came back, dtypes and the keys of dicts too."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key], tolerance)
    elif isinstance(first, tuple | list):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other, tolerance)
    elif isinstance(first, np.ndarray):
        assert (first.dtype, first.shape) == (second.dtype, second.shape)
        if first.dtype == object:
            assert_same(first.tolist(), second.tolist(), tolerance)
        elif first.dtype.kind == "f":
            np.testing.assert_allclose(first, second, rtol=0, atol=tolerance)
        else:
            np.testing.assert_array_equal(first, second)
    else:
        assert type(first) is type(second)
        assert first == (pytest.approx(second, abs=tolerance) if type(first) is float else second)


def lock_step(keywords, n_steps, env_id=SHORT, **more):
    """Hold n scalar environments of seeds s + i, wherever they are, against the batch."""
    keywords = {**EPISODES, **keywords}
    batch = gym.make_vec(env_id, num_envs=3, **more, **keywords)
    vectorise = {"autoreset_mode": more["autoreset_mode"]} if more else None
    singles = gym.make_vec(
        env_id, num_envs=3, vectorization_mode="sync", vector_kwargs=vectorise, **keywords
    )
    assert batch.action_space == singles.action_space
    assert batch.observation_space == singles.observation_space
    assert_same(batch.reset(seed=7), singles.reset(seed=7))
    batch.action_space.seed(1)
    for _ in range(n_steps):
        actions = batch.action_space.sample()
        came_back = batch.step(actions)
        assert came_back[0] in batch.observation_space
        assert_same(came_back, singles.step(actions))
    assert_same(batch.np_random_seed, singles.np_random_seed)
    draws = [[g.integers(2**63) for g in env.np_random] for env in (batch, singles)]
    assert draws[0] == draws[1]


@pytest.mark.parametrize(
    ("estimator", "action", "privacy"),
    [(e, a, "paper") for e in ESTIMATORS for a in ACTION_ENCODINGS]
    + [(e, "mask", COUNTED) for e in ESTIMATORS],
)
def test_a_batch_is_so_many_scalar_environments(estimator, action, privacy):
    keywords = {"estimator": estimator, "action": action, "privacy": privacy}
    lock_step({**keywords, "truth_in_info": True}, n_steps=17)


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_id_is_so_many_scalar_environments(env_id):
    lock_step({"traffic_seeds": "0:2"}, n_steps=8, env_id=f"dptse_env:{env_id}")


@pytest.mark.parametrize("truth_in_info", [False, True])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_autoreset_is_that_of_gymnasium(mode, truth_in_info):
    keywords = {"truth_in_info": truth_in_info, "privacy": COUNTED}
    lock_step(keywords, n_steps=20, autoreset_mode=mode)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_mode_is_declared(mode):
    for env in (short(autoreset_mode=mode), short(autoreset_mode=mode.value)):
        assert env.metadata["autoreset_mode"] is mode
    assert short().metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP


def test_next_step_ignores_the_action_of_an_episode_that_begins_again():
    env, other = short(), short()
    for one in (env, other):
        one.reset(seed=3)
        one.reset(options={"reset_mask": np.array([True, False, True])})
        for _ in range(6):
            one.step(np.zeros((3, 6), dtype=np.int8))
    actions = np.zeros((3, 6), dtype=np.int8)
    came_back = env.step(actions)
    assert came_back[1].tolist() == [0.0] * 3
    assert came_back[4]["_privacy"].all()
    assert_same(came_back, other.step(actions + 5))


def staggered(**keywords):
    """Return an environment whose episodes 0 and 2 are two steps behind episode 1."""
    env = short(**keywords)
    actions = np.zeros((3, 6), dtype=np.int8)
    env.reset(seed=3)
    env.step(actions)
    env.step(actions)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    return env, actions


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_staggered_episodes_end_and_begin_on_their_own(mode):
    env, actions = staggered(autoreset_mode=mode)
    truncated, privacy, final = [], [], []
    for _ in range(8):
        *_, done, infos = env.step(actions)
        truncated.append(done.tolist())
        privacy.append(infos.get("_privacy", np.zeros(3, bool)).tolist())
        final.append(infos.get("_final_obs", np.zeros(3, bool)).tolist())
        assert infos["_rmse_density"].all()
    none, middle, sides = [False] * 3, [False, True, False], [True, False, True]
    assert truncated == [none] * 3 + [middle, none, sides, none, none]
    late = mode == "NextStep"
    assert privacy == ([none] * late + truncated)[:8]
    assert final == ([none] * 8 if late else truncated)


def test_reset_mask_is_that_of_gymnasium():
    keywords = {"truth_in_info": True, **EPISODES}
    mode = {"autoreset_mode": "Disabled"}
    batch = gym.make_vec(SHORT, num_envs=3, **mode, **keywords)
    singles = gym.make_vec(
        SHORT, num_envs=3, vectorization_mode="sync", vector_kwargs=mode, **keywords
    )
    assert_same(batch.reset(seed=7), singles.reset(seed=7))
    actions = np.eye(3, 6, dtype=np.int8)
    for k, mask in enumerate(([True, False, True], [False, True, False], [True] * 3)):
        assert_same(batch.step(actions), singles.step(actions))
        options = {"reset_mask": np.array(mask)}
        seed = 40 if k == 1 else None
        came_back = batch.reset(seed=seed, options=options)
        assert "reset_mask" in options
        assert_same(came_back, singles.reset(seed=seed, options=options))
        assert came_back[1]["_privacy"].tolist() == mask
    assert_same(batch.step(actions), singles.step(actions))


def test_disabled_autoreset_asks_for_a_reset():
    env, actions = staggered(autoreset_mode="Disabled")
    for _ in range(4):
        *_, truncated, _ = env.step(actions)
    assert truncated.tolist() == [False, True, False]
    with pytest.raises(gym.error.ResetNeeded, match="1 of 3 episodes are over and autoreset is"):
        env.step(actions)
    env.reset(options={"reset_mask": truncated})
    *_, truncated, _ = env.step(actions)
    assert not truncated.any()


def test_reset_options_hold_for_one_reset():
    env = short(truth_in_info=True)
    options = {"traffic_seed": 2, "start": 100}
    truth = env.reset(seed=0, options=options)[1]["truth"]
    assert truth["traffic_seed"].tolist() == [2] * 3
    assert truth["time"].tolist() == [100] * 3
    assert options == {"traffic_seed": 2, "start": 100}
    starts = {second for _ in range(5) for second in env.reset()[1]["truth"]["time"].tolist()}
    assert len(starts) > 5


def test_seeds_one_by_one():
    together, apart, mixed = short(), short(), short()
    actions = np.ones((3, 6), dtype=np.int8)
    seen = []
    for env, seed in ((together, 5), (apart, [5, 6, 7]), (mixed, [5, None, 7])):
        env.reset(seed=seed)
        seen.append(env.step(actions)[0])
    np.testing.assert_array_equal(seen[0], seen[1])
    assert (seen[0] == seen[2]).all(axis=1).tolist() == [True, False, True]
    own = mixed.np_random_seed[1]
    mixed.reset(seed=[8, None, 9])
    assert mixed.np_random_seed == (8, own, 9)


def test_what_is_returned_is_not_touched_later():
    env, actions = staggered(autoreset_mode="SameStep", truth_in_info=True)
    seen = [env.reset(seed=0)] + [env.step(actions) for _ in range(7)]
    kept = pickle.loads(pickle.dumps(seen))
    for _ in range(7):
        env.step(actions)
    env.reset()
    assert_same(seen, kept, tolerance=0)


@pytest.mark.parametrize("truth_in_info", [False, True])
def test_infos_become_the_scalar_ones(truth_in_info):
    keywords = {**EPISODES, "privacy": COUNTED, "truth_in_info": truth_in_info}
    wrapped = DictInfoToList(RecordEpisodeStatistics(short(**keywords)))
    scalar = gym.make(SHORT, **keywords)
    wrapped.reset(seed=8)
    scalar.reset(seed=9)
    for _ in range(6):
        *_, infos = wrapped.step(np.zeros((3, 6), dtype=np.int8))
        info = scalar.step(np.zeros(6, dtype=np.int8))[4]
        assert infos[1].keys() - {"episode"} == info.keys()
        assert infos[1]["rmse_density"] == info["rmse_density"]
    assert [one["episode"]["l"] for one in infos] == [6] * 3


def test_each_episode_is_charged_from_its_own_beginning():
    (env, actions), cap = staggered(privacy=COUNTED), COUNTED["cap"]
    for k in range(1, 5):
        infos = env.step(actions)[4]
        mu, epsilon = env.process.accountant.spent(np.array([k, min(k + 2, cap), k]))
        np.testing.assert_array_equal(infos["mu"], mu)
        np.testing.assert_array_equal(infos["epsilon"], epsilon)
        assert infos["mu"][0] < infos["mu"][1] or k >= cap


def test_action_masks():
    env = short(action="sequential", bandwidth=3)
    with pytest.raises(gym.error.ResetNeeded, match="3 of 3 episodes were never begun"):
        env.action_masks()
    env.reset(seed=0)
    env.step(np.array([0, 4, 5]))
    masks = env.action_masks()
    assert masks.shape == (3, 6)
    assert np.argwhere(~masks).tolist() == [[0, 0], [1, 4], [2, 5]]
    with pytest.raises(ValueError, match="needs action='sequential', this is 'mask'"):
        short().action_masks()


def test_a_pickled_environment_goes_on_where_it_was():
    env, actions = staggered()
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(8):
        assert_same(env.step(actions), copy.step(actions), tolerance=0)


def test_a_spec_survives_json():
    env = short(autoreset_mode="SameStep")
    again = gym.make_vec(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    assert again.num_envs == 3
    assert_same(env.reset(seed=1), again.reset(seed=1), tolerance=0)


def test_one_episode_and_closing_twice():
    env = short(num_envs=1)
    assert env.reset(seed=0)[0].shape == (1, *env.single_observation_space.shape)
    env.close()
    env.close()
    assert env.closed


def test_no_work_in_a_constructor():
    code = (
        "import sys, gymnasium as gym; gym.make_vec('dptse_env:dptse/PaperHighway-v0', 4); "
        "print({'libsumo', 'torch', 'stable_baselines3'} & set(sys.modules) or 'light')"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.stdout.strip() == "light", result.stderr


def test_a_void_guarantee_is_warned_of_at_the_caller():
    with pytest.warns(UserWarning, match="no privacy is guaranteed") as caught:
        SensorQueryVectorEnv(2, "private-highway", privacy={"boundary_inputs": "true"})
    assert [warning.filename for warning in caught] == [__file__]


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"num_envs": 0}, r"^num_envs must be an integer >= 1, got 0"),
        ({"num_envs": -2}, r"^num_envs must be an integer >= 1, got -2"),
        ({"num_envs": 1.5}, r"^num_envs must be an integer >= 1, got 1\.5"),
        ({"num_envs": True}, r"^num_envs must be an integer >= 1, got True"),
        (
            {"autoreset_mode": "next"},
            r"^autoreset_mode must be one of NextStep, SameStep, Disabled, got 'next'",
        ),
        ({"autoreset_mode": None}, r"^autoreset_mode must be one of .*, got None"),
        ({"render_mode": "rgb_array"}, r"^render_mode must be None, got 'rgb_array': a batch"),
        ({"bandwith": 2}, r"^bandwith is unknown; allowed: corridor, estimator"),
        ({"epsilon": -1}, r"^privacy\.epsilon must be > 0, got -1"),
    ],
)
def test_bad_keywords_name_themselves(keywords, message):
    with pytest.raises(ValueError, match=message):
        SensorQueryVectorEnv(**{"num_envs": 2, "preset": "short-highway", **keywords})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"options": {"reset_mask": [True] * 3}}, r"reset_mask must be a bool array .*, got list"),
        ({"options": {"reset_mask": None}}, r"reset_mask must be a bool array .*, got NoneType"),
        (
            {"options": {"reset_mask": np.ones(2, bool)}},
            r"reset_mask must be a bool array of shape \(3,\), got bool of shape \(2,\)",
        ),
        ({"options": {"reset_mask": np.ones(3)}}, r"got float64 of shape \(3,\)"),
        (
            {"options": {"reset_mask": np.zeros(3, bool)}},
            r"reset_mask must name at least one episode",
        ),
        ({"options": {"seed": 1}}, r"options\.seed is unknown"),
        ({"options": {"start": 999}}, r"options\.start must be an integer in 0\.\.234, got 999"),
        ({"seed": [1, 2]}, r"seed must be one or a list of 3, got 2"),
    ],
)
def test_bad_resets_are_refused_and_the_episodes_go_on(arguments, message):
    (env, actions), (undisturbed, _) = staggered(), staggered()
    with pytest.raises(ValueError, match=message):
        env.reset(**arguments)
    for _ in range(5):
        assert_same(env.step(actions), undisturbed.step(actions), tolerance=0)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.zeros((2, 6), np.int8), r"actions must have shape \(3, 6\), got \(2, 6\)"),
        (np.zeros((4, 6), np.int8), r"actions must have shape \(3, 6\), got \(4, 6\)"),
        (np.zeros((3, 5), np.int8), r"action must have shape \(6,\)"),
        (np.full((3, 6), 2), r"action must hold 0 and 1 only"),
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
    with pytest.raises(gym.error.ResetNeeded, match="3 of 3 episodes were never begun"):
        env.step(actions)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(gym.error.ResetNeeded, match="2 of 3 episodes were never begun"):
        env.step(actions)
