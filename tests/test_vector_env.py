"""`SensorQueryVectorEnv`: a batch is as many scalar environments, in Gymnasium's vector form."""

import pickle
import threading
import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from dptse_env.estimators import ESTIMATORS
from dptse_env.registration import ENVIRONMENTS
from dptse_env.utils.threads import SMALLEST_BLOCK
from dptse_env.vector_env import SensorQueryVectorEnv
from tests.helpers import (
    COUNTED,
    EPISODES,
    SHORT,
    assert_same,
    briefly,
    fast_and_slow,
    lock_step,
    make_batch,
)


def staggered(**keywords):
    """Return an environment whose episodes 0 and 2 are two steps behind episode 1."""
    env = make_batch(**keywords)
    actions = np.zeros((3, 6), dtype=np.int8)
    env.reset(seed=3)
    env.step(actions)
    env.step(actions)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    return env, actions


# --- lock step with the scalar environment --------------------------------------------------------


@pytest.mark.parametrize(
    ("estimator", "action", "privacy"),
    [
        ("ekf", "mask", COUNTED),
        ("ukf", "scores", "paper"),
        ("enkf", "slots", "paper"),
        ("mhe", "sequential", "paper"),
        ("blend", "mask", COUNTED),
        ("recurrent", "slots", "paper"),
    ],
)
def test_a_batch_is_so_many_scalar_environments(estimator, action, privacy):
    keywords = {"estimator": estimator, "action": action, "privacy": privacy}
    lock_step({**keywords, "truth_in_info": True}, n_steps=17)


LONG = [name for name in ENVIRONMENTS if "Long" in name]


@pytest.mark.parametrize("env_id", fast_and_slow(ENVIRONMENTS, set(ENVIRONMENTS) - set(LONG)))
def test_every_id_is_so_many_scalar_environments(env_id):
    lock_step({"traffic_seeds": "0:2", **briefly(env_id)}, n_steps=8, env_id=f"dptse_env:{env_id}")


@pytest.mark.parametrize(
    ("mode", "truth_in_info"), [("NextStep", False), ("NextStep", True), ("SameStep", True)]
)
def test_autoreset_is_that_of_gymnasium(mode, truth_in_info):
    keywords = {"truth_in_info": truth_in_info, "privacy": COUNTED}
    lock_step(keywords, n_steps=20, autoreset_mode=mode)


@pytest.mark.parametrize(
    "estimator", fast_and_slow(ESTIMATORS, ["ekf", "enkf", "mhe", "recurrent"])
)
def test_threads_change_nothing(estimator):
    n = 3 * SMALLEST_BLOCK
    one, two = (make_batch(n, estimator=estimator, threads=threads) for threads in (1, 2))
    assert_same(one.reset(seed=5), two.reset(seed=5))
    one.action_space.seed(1)
    for _ in range(8):
        actions = one.action_space.sample()
        assert_same(one.step(actions), two.step(actions))


@pytest.mark.parametrize(
    ("estimator", "threads_given", "n_names"),
    [("ekf", 1, 1), ("ekf", 2, 2), ("enkf", 2, 2), ("random_walk", 2, 1)],
)
def test_compiled_estimators_work_on_so_many_threads(
    estimator, threads_given, n_names, monkeypatch
):
    env = make_batch(2 * SMALLEST_BLOCK, estimator=estimator, threads=threads_given)
    env.reset(seed=0)
    names, predict = set(), env.process.estimator.predict

    def watched(episodes, inputs):
        names.add(threading.current_thread().name)
        time.sleep(0.02)
        predict(episodes, inputs)

    monkeypatch.setattr(env.process.estimator, "predict", watched)
    env.step(env.action_space.sample())
    assert len(names) == n_names


def test_traffic_and_start_one_by_one():
    env, single = make_batch(truth_in_info=True), make_batch(1, truth_in_info=True)
    options = {"traffic_seed": [2, 0, 2], "start": np.array([100, 3, 0])}
    observation, infos = env.reset(seed=4, options=options)
    for episode in range(3):
        own = {key: int(values[episode]) for key, values in options.items()}
        alone, info = single.reset(seed=4 + episode, options=own)
        np.testing.assert_array_equal(observation[episode], alone[0])
        for key in ("traffic_seed", "time"):
            assert infos["truth"][key][episode] == info["truth"][key][0]
    options["reset_mask"] = np.array([False, True, True])
    options["start"] = [999, 7, 8]  # of an episode that goes on, and so never looked at
    assert env.reset(options=options)[1]["truth"]["time"].tolist() == [0, 7, 8]


# --- autoreset, infos and seeds -------------------------------------------------------------------


def test_next_step_ignores_the_action_of_an_episode_that_begins_again():
    env, other = make_batch(), make_batch()
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


def test_seeds_one_by_one():
    together, apart, mixed = make_batch(), make_batch(), make_batch()
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
    assert_same(seen, kept)


def test_infos_become_the_scalar_ones():
    keywords = {**EPISODES, "privacy": COUNTED, "truth_in_info": True}
    wrapped = DictInfoToList(RecordEpisodeStatistics(make_batch(**keywords)))
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
        mu, epsilon = env.process.release.spent(np.arange(3), np.array([k, min(k + 2, cap), k]))
        np.testing.assert_array_equal(infos["mu"], mu)
        np.testing.assert_array_equal(infos["epsilon"], epsilon)
        assert infos["mu"][0] < infos["mu"][1] or k >= cap


def test_a_pickled_environment_goes_on_where_it_was():
    env, actions = staggered()
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(8):
        assert_same(env.step(actions), copy.step(actions))


def test_a_void_guarantee_is_warned_of_at_the_caller():
    with pytest.warns(UserWarning, match="no privacy is guaranteed") as caught:
        SensorQueryVectorEnv(2, "private-highway", privacy={"boundary_inputs": "true"})
    assert [warning.filename for warning in caught] == [__file__]


def test_it_draws_the_chosen_episode_as_the_scalar_environment_does():
    env = make_batch(num_envs=3, render_mode="rgb_array", render_episode=2, horizon=20)
    with pytest.raises(gym.error.ResetNeeded, match="nothing to render"):
        env.render()
    alone = gym.make(SHORT, render_mode="rgb_array", horizon=20)
    options = {"traffic_seed": 0, "start": 0}
    env.reset(seed=5, options=options)
    alone.reset(seed=7, options=options)
    actions = np.zeros((3, 6), dtype=np.int8)
    actions[:, :2], actions[2] = 1, [0, 0, 1, 1, 0, 0]
    for _ in range(12):
        env.step(actions)
        alone.step(actions[2])
    (picture,) = env.render()
    assert (picture == alone.render()).all()
    # The next episode begins with an empty picture.
    for _ in range(9):
        env.step(actions)
    assert len(env.drawing.history.truth) == 1
    assert (env.render()[0] != picture).any()


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"num_envs": 0}, r"^num_envs must be an integer in 1\.\.1000000, got 0"),
        ({"num_envs": True}, r"^num_envs must be an integer in 1\.\.1000000, got True"),
        ({"autoreset_mode": "next"}, r"^autoreset_mode must"),
        ({"render_mode": "human"}, r"^render_mode must be None or 'rgb_array', got 'human'"),
        ({"render_episode": 3}, r"^render_episode must be an integer in 0\.\.1, got 3"),
        ({"threads": 0}, r"^threads must be an integer in 1\.\.1024, got 0"),
        (
            {"estimator": "mhe", "estimator_settings": {"process_noise": [0.01, 0.0]}},
            r"^estimator_settings\.process_noise\[1\] must be",
        ),
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
        assert_same(env.step(actions), undisturbed.step(actions))


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
        assert_same(env.step(actions), undisturbed.step(actions))
    # Episode 1 is over now, or has just been begun again.
    if mode == "Disabled":
        for one in (env, undisturbed):
            one.reset(options={"reset_mask": np.array([False, True, False])})
    with pytest.raises(ValueError, match=message):
        env.step(bad)
    for _ in range(3 if mode == "Disabled" else 5):
        came_back = env.step(actions)
        assert_same(came_back, undisturbed.step(actions))
        if mode == "Disabled" and came_back[3].any():
            break


def test_a_step_before_the_first_reset_is_refused():
    env = make_batch()
    actions = np.zeros((3, 6), dtype=np.int8)
    with pytest.raises(gym.error.ResetNeeded, match="3 of 3 episodes were never reset"):
        env.step(actions)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(gym.error.ResetNeeded, match="2 of 3 episodes were never reset"):
        env.step(actions)
