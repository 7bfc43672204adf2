"""`SensorQueryVectorEnv`: a batch is as many scalar environments, in Gymnasium's vector form."""

import pickle
import threading
import warnings

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.env import SensorQueryEnv
from dptse_env.estimators import ESTIMATORS
from dptse_env.registration import ENVIRONMENTS
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.utils.threads import SMALLEST_BLOCK
from dptse_env.vector_env import SensorQueryVectorEnv
from tests.helpers import (
    COUNTED,
    PAID,
    SHORT,
    assert_same,
    briefly,
    fast_and_slow,
    lock_step,
    make_batch,
)

ACTIONS = np.zeros((3, 6), dtype=np.int8)


def staggered(**keywords):
    """Return a batch whose episodes 0 and 2 are two steps behind episode 1."""
    env = make_batch(**keywords)
    env.reset(seed=3)
    env.step(ACTIONS)
    env.step(ACTIONS)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    return env


# --- lock step with the scalar environment --------------------------------------------------------

EVERY_WAY = [(e, a, "printed") for e in ESTIMATORS for a in ACTION_ENCODINGS]
EVERY_WAY += [(e, "mask", privacy) for e in ESTIMATORS for privacy in (COUNTED, PAID)]
WAYS = [
    ("ekf", "sequential", "printed"), ("ukf", "mask", COUNTED), ("enkf", "scores", "printed"),
    ("mhe", "mask", PAID), ("blend", "mask", COUNTED), ("recurrent", "slots", "printed"),
]  # fmt: skip


@pytest.mark.parametrize(("estimator", "action", "privacy"), fast_and_slow(EVERY_WAY, WAYS))
def test_a_batch_is_so_many_scalar_environments(estimator, action, privacy):
    keywords = {"estimator": estimator, "action": action, "privacy": privacy}
    lock_step({**keywords, "truth_in_info": True}, n_steps=17)


LONG = [name for name in ENVIRONMENTS if "Long" in name]


@pytest.mark.parametrize("env_id", fast_and_slow(ENVIRONMENTS, set(ENVIRONMENTS) - set(LONG)))
def test_every_id_is_so_many_scalar_environments(env_id):
    lock_step({"traffic_seeds": "0:2", **briefly(env_id)}, n_steps=8, env_id=f"dptse_env:{env_id}")


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("truth_in_info", [False, True])
def test_autoreset_is_that_of_gymnasium(mode, truth_in_info):
    keywords = {"truth_in_info": truth_in_info, "privacy": COUNTED}
    lock_step(keywords, n_steps=20, autoreset_mode=mode)


@pytest.mark.parametrize(
    "estimator", fast_and_slow(ESTIMATORS, ["ekf", "enkf", "mhe", "recurrent"])
)
def test_threads_change_nothing(estimator):
    """Nor where all episodes go through an interval of loops again."""
    n, given = 3 * SMALLEST_BLOCK, {"loops": {"positions": [0.3], "interval": 10}}
    one, two = (make_batch(n, threads=t, estimator=estimator, **given) for t in (1, 2))
    assert_same(*(each.reset(seed=5, options={"start": 4}) for each in (one, two)))
    one.action_space.seed(1)
    for _ in range(8):
        actions = one.action_space.sample()
        assert_same(one.step(actions), two.step(actions))


@pytest.mark.parametrize(("estimator", "threads", "n"), [("ekf", 1, 1), ("enkf", 2, 2)])
def test_compiled_estimators_work_on_so_many_threads(estimator, threads, n, monkeypatch):
    env = make_batch(2 * SMALLEST_BLOCK, estimator=estimator, threads=threads)
    env.reset(seed=0)
    names, predict = set(), env.process.estimator.predict
    together = threading.Barrier(n, timeout=300.0)

    def watched(episodes, inputs):
        together.wait()
        names.add(threading.current_thread().name)
        predict(episodes, inputs)

    monkeypatch.setattr(env.process.estimator, "predict", watched)
    env.step(env.action_space.sample())
    assert len(names) == n


# --- what scalar environments do not have ---------------------------------------------------------


def test_traffic_start_and_seeds_one_by_one():
    env, single = make_batch(truth_in_info=True), make_batch(1, truth_in_info=True)
    options = {"traffic_seed": [2, 0, 2], "start": np.array([100, 3, 0])}
    observation, infos = env.reset(seed=[4, 9, 6], options=options)
    for episode, seed in enumerate((4, 9, 6)):
        own = {key: int(values[episode]) for key, values in options.items()}
        alone, info = single.reset(seed=seed, options=own)
        np.testing.assert_array_equal(observation[episode], alone[0])
        assert infos["traffic_seed"][episode] == info["traffic_seed"][0] == own["traffic_seed"]
        assert infos["time"][episode] == info["time"][0]
    options["reset_mask"] = np.array([False, True, True])
    options["start"] = [999, 7, 8]  # of an episode that goes on, and so never looked at
    assert env.reset(options=options)[1]["time"].tolist() == [0, 7, 8]
    env.reset(seed=[8, None, 9])
    assert env.np_random_seed == (8, 9, 9)


def test_what_is_returned_is_not_touched_later():
    env = staggered(autoreset_mode="SameStep", truth_in_info=True)
    seen = [env.reset(seed=0)] + [env.step(ACTIONS) for _ in range(7)]
    kept = pickle.loads(pickle.dumps(seen))
    for _ in range(7):
        env.step(ACTIONS)
    env.reset()
    assert_same(seen, kept)


def test_a_void_guarantee_is_warned_of_once_however_environments_are_made():
    void = {"boundary_inputs": "true"}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        SensorQueryVectorEnv(2, "private-highway", privacy=void)
        SensorQueryEnv("private-highway", privacy=void)
    (message,) = (str(each.message) for each in told)
    assert "no privacy is guaranteed" in message


def test_it_draws_the_chosen_episode_as_the_scalar_environment_does():
    env = make_batch(render_mode="rgb_array", render_episode=2, horizon=20)
    with pytest.raises(gym.error.ResetNeeded):
        env.render()
    alone = gym.make(SHORT, render_mode="rgb_array", horizon=20)
    options = {"traffic_seed": 0, "start": 0}
    env.reset(seed=5, options=options)
    alone.reset(seed=7, options=options)
    actions = ACTIONS.copy()
    actions[:, :2], actions[2] = 1, [0, 0, 1, 1, 0, 0]
    for _ in range(12):
        env.step(actions)
        alone.step(actions[2])
    (picture,) = env.render()
    assert (picture == alone.render()).all()
    for _ in range(9):  # the next episode begins with an empty picture
        env.step(actions)
    assert len(env.drawing.history.truth) == 1


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"num_envs": 0}, r"num_envs must .* 1\.\.1000000, got 0"),
        ({"autoreset_mode": "next"}, "autoreset_mode must"),
        ({"render_mode": "human"}, "render_mode must .* got 'human'"),
        ({"render_episode": 3}, r"render_episode must .* 0\.\.1, got 3"),
        ({"threads": 0}, r"threads must .* 1\.\.1024, got 0"),
    ],
)
def test_bad_keywords_name_themselves(keywords, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        SensorQueryVectorEnv(**{"num_envs": 2, "preset": "short-plain", **keywords})


BAD_RESETS = [
    ({"options": {"reset_mask": [True] * 3}}, "reset_mask must be a bool array .*, got list"),
    ({"options": {"reset_mask": np.ones(2, bool)}}, "reset_mask must"),
    ({"options": {"reset_mask": np.zeros(3, bool)}}, "reset_mask must"),
    ({"options": {"start": [1, 2]}}, r"options\.start must"),
    ({"options": {"traffic_seed": [0, 1, 7]}}, r"options\.traffic_seed must be .*, got 7"),
    ({"seed": [1, 2]}, "seed must be an integer or a list of 3, got 2"),
]
BAD_ACTIONS = [
    (np.zeros((2, 6), np.int8), r"actions must have shape \(3, 6\), got \(2, 6\)"),
    (np.zeros((3, 5), np.int8), r"action must have shape \(6,\)"),
    (np.full((3, 6), 2), "action must hold 0 and 1 only"),
]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_what_is_refused_leaves_the_episodes_as_they_were(mode):
    env, undisturbed = (staggered(autoreset_mode=mode) for _ in range(2))
    for _ in range(4):  # episode 1 is over then, or has just been begun again
        assert_same(env.step(ACTIONS), undisturbed.step(ACTIONS))
    for arguments, message in BAD_RESETS:
        with pytest.raises(ValueError, match=message):
            env.reset(**arguments)
    for actions, message in BAD_ACTIONS:
        with pytest.raises(ValueError, match=message):
            env.step(actions)
    for _ in range(5):
        assert_same(env.step(ACTIONS), undisturbed.step(ACTIONS))


def test_episodes_that_never_began_or_are_over_ask_for_a_reset():
    env = make_batch(autoreset_mode="Disabled")
    with pytest.raises(gym.error.ResetNeeded, match="3 of 3 episodes were never reset"):
        env.step(ACTIONS)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(gym.error.ResetNeeded, match="2 of 3 episodes were never reset"):
        env.step(ACTIONS)
    env = staggered(autoreset_mode="Disabled")
    for _ in range(4):
        *_, truncated, _ = env.step(ACTIONS)
    with pytest.raises(gym.error.ResetNeeded, match="1 of 3 episodes are over"):
        env.step(ACTIONS)
    env.reset(options={"reset_mask": truncated})
    assert not env.step(ACTIONS)[3].any()
