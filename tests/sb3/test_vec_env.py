"""`SB3VecEnv` is a ``DummyVecEnv`` of scalar environments; agents learn on it, with replicas."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from dptse_env.sb3 import ReplicaBaseline, SB3VecEnv
from tests.helpers import EPISODES, SHORT, SumRelease, assert_same, make_batch

ACTIONS = np.eye(3, 6, dtype=np.int8)


def make(num_envs=3, replicas=1, **keywords):
    keywords = {"autoreset_mode": "SameStep", **keywords}
    return SB3VecEnv(make_batch(num_envs, **keywords), replicas)


@pytest.mark.parametrize(
    ("action", "truth_in_info"),
    [("mask", True), ("scores", False), ("slots", True), ("sequential", False)],
)
def test_it_is_a_dummy_vec_env_of_scalar_environments(action, truth_in_info):
    keywords = {"action": action, "truth_in_info": truth_in_info, "privacy": "capped"}
    env = make(**keywords)
    other = DummyVecEnv([lambda: gym.make(SHORT, **EPISODES, **keywords)] * 3)
    space = env.action_space
    assert (space, env.observation_space) == (other.action_space, other.observation_space)
    for one in (env, other):
        one.seed(4)
    assert_same(env.reset(), other.reset(), 1e-10)
    space.seed(1)
    n_ended = 0
    for k in range(40):
        if k == 30:
            assert_same(env.reset(), other.reset(), 1e-10)
        actions = np.array([space.sample() for _ in range(3)])
        (*here, infos), (*there, expected) = env.step(actions), other.step(actions)
        assert_same(here, there, 1e-10)
        ends = [full if done else {} for full, done in zip(expected, there[2], strict=True)]
        assert_same(infos, ends, 1e-10)
        assert_same(env.reset_infos, other.reset_infos, 1e-10)
        n_ended += there[2].sum()
    assert n_ended == (6 if action == "sequential" else 18)


def test_seeds_and_options_hold_for_one_reset():
    env = make(truth_in_info=True)
    env.seed(3)
    env.set_options([{"start": 7}, {"start": 9, "traffic_seed": 1}, {"start": 7}])
    env.reset()
    first = env.step(ACTIONS)[1]
    assert [info["time"] for info in env.reset_infos] == [7, 9, 7]
    assert env.reset_infos[1]["traffic_seed"] == 1
    starts = set()
    for _ in range(6):
        env.reset()
        starts |= {info["time"] for info in env.reset_infos}
    assert len(starts) > 5
    assert (env.step(ACTIONS)[1] != first).all()
    for options in ({"reset_mask": np.ones(3, bool)}, {"stop": 3}):
        env.set_options(options)
        with pytest.raises(ValueError, match=rf"options\.{next(iter(options))} is"):
            env.reset()


def test_action_masks():
    env = VecMonitor(make(action="sequential", bandwidth=3))
    env.reset()
    env.step(np.array([0, 4, 5]))
    masks = np.stack(env.env_method("action_masks"))
    assert np.argwhere(~masks).tolist() == [[0, 0], [1, 4], [2, 5]]
    (one,) = env.env_method("action_masks", indices=1)
    np.testing.assert_array_equal(one, masks[1])
    methods = env.get_attr("action_masks", indices=[1, 0])
    np.testing.assert_array_equal([method() for method in methods], masks[[1, 0]])
    assert env.has_attr("action_masks")
    plain = make()
    plain.reset()
    assert np.stack(plain.env_method("action_masks")).all()
    with pytest.raises(AttributeError, match="env_method knows action_masks, got 'render'"):
        plain.env_method("render")


def test_attributes():
    env = make()
    env.reset()
    assert env.get_attr("observation_space", indices=[0, 2]) == [env.observation_space] * 2
    assert env.get_attr("config", 0)[0].horizon == 6
    assert env.get_attr("np_random", [2]) == [env.env.np_random[2]]
    assert env.env_is_wrapped(Monitor) == [False] * 3
    assert not env.has_attr("nothing")
    with pytest.raises(AttributeError, match="horizon cannot be set"):
        env.set_attr("horizon", 3)
    with pytest.raises(AttributeError, match="got 'reset'"):
        env.env_method("reset")
    env.step(ACTIONS)
    with pytest.raises(RuntimeError, match="call step_async"):
        env.step_wait()
    env.close()
    env.close()


def test_other_environments_are_refused():
    with pytest.raises(ValueError, match=r"autoreset_mode='SameStep', .* got 'NextStep'"):
        make(autoreset_mode="NextStep")
    wrapped = gym.wrappers.vector.RecordEpisodeStatistics(make_batch(autoreset_mode="SameStep"))
    for env in (wrapped, gym.make_vec(SHORT, 2, vectorization_mode="sync", **EPISODES)):
        with pytest.raises(ValueError, match="must be a bare SensorQueryVectorEnv, got"):
            SB3VecEnv(env)


def test_maskable_ppo_picks_what_fits_where_decisions_take_different_numbers_of_actions():
    env = make(action="sequential", horizon=12, privacy=SumRelease, query_spans=(1, 2), bandwidth=3)
    dropped = []

    def count(scope, _):
        dropped.append(sum(info.get("n_dropped", 0.0) for info in scope["infos"]))
        dropped.append(env.env.process.n_dropped.sum())
        return True

    model = MaskablePPO("MlpPolicy", env, n_steps=20, batch_size=30, seed=0)
    model.learn(60, callback=count)
    assert len(dropped) == 2 * 20
    assert not any(dropped)
    picks = model.rollout_buffer.actions[..., 0]
    assert set(np.unique(picks).astype(int)) <= set(range(11))


def groups_of(env, value):
    """Return what each replica has, shape (groups, replicas, ...)."""
    return np.reshape(value, (env.num_envs // env.replicas, env.replicas, -1))


@pytest.mark.parametrize(
    ("seed", "keywords"),
    [
        (5, {}),
        (None, {"estimator": "enkf", "sensor_settings": {"dropout": 0.1}}),
        (5, {"action": "sequential", "privacy": SumRelease, "query_spans": (1, 2), "bandwidth": 3}),
    ],
)
def test_replicas_meet_the_same_traffic_and_noise_after_resets_too(seed, keywords):
    env = make(6, 3, **{"truth_in_info": True, "privacy": "capped", **keywords})
    if seed is not None:
        assert env.seed(seed) == [5, 5, 5, 6, 6, 6]
    env.action_space.seed(0)
    starts = set()
    for step in range(40):
        if step in (0, 20):
            observation = env.reset()
        else:
            actions = np.repeat([env.action_space.sample() for _ in range(2)], 3, axis=0)
            observation, rewards, dones, _ = env.step(actions)
            assert (groups_of(env, rewards) == groups_of(env, rewards)[:, :1]).all()
            assert (groups_of(env, dones) == groups_of(env, dones)[:, :1]).all()
            assert dones.all() or rewards[0] == 0.0 or rewards[0] != rewards[3]
        groups = groups_of(env, observation)
        assert (groups == groups[:, :1]).all()
        places = [(info["traffic_seed"], info["time"]) for info in env.reset_infos]
        assert places[:3] == places[:1] * 3
        assert places[3:] == places[3:4] * 3
        starts |= {places[0], places[3]}
    assert len(starts) > 4


def test_what_a_replica_does_changes_nothing_for_the_others():
    def play(first):
        env = make(3, 3, truth_in_info=True, privacy="capped")
        env.seed(2)
        env.reset()
        steps = [env.step(np.stack([one, ACTIONS[0], ACTIONS[0]])) for one in first]
        return env, [np.column_stack([step[0], step[1]]) for step in steps]

    (_, alike), (env, apart) = play(ACTIONS[[0] * 8]), play(ACTIONS[[0, 1, 2] * 3])
    for one, other in zip(alike, apart, strict=False):
        assert (one[1:] == other[1:]).all()
    assert any((one[0] != other[0]).any() for one, other in zip(alike, apart, strict=False))
    assert len({info["time"] for info in env.reset_infos}) == 1


class Look(BaseCallback):
    """Keeps what the last rollout left at this place among the callbacks."""

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.model.rollout_buffer
        self.advantages, self.returns = buffer.advantages.copy(), buffer.returns.copy()


def test_the_baseline_of_an_advantage_is_the_mean_of_the_other_replicas():
    env = VecNormalize(make(6, 3))
    before, after = Look(), Look()
    model = PPO("MlpPolicy", env, n_steps=4, batch_size=24, seed=0, device="cpu")
    model.learn(24, [before, ReplicaBaseline(3), after])
    others = np.kron(np.eye(2), (1 - np.eye(3)) / 2)
    expected = before.advantages - before.advantages @ others
    np.testing.assert_allclose(after.advantages, expected, atol=1e-6)
    assert (after.returns == before.returns).all()
    assert (after.advantages != before.advantages).any()


def test_replicas_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="replicas must divide 3 episodes, got 2"):
        make(3, 2)
    with pytest.raises(ValueError, match="replicas must be"):
        make(3, 0)
    with pytest.raises(ValueError, match=r"privacy\.noise must not be 'secure'"):
        make(2, 2, privacy={"noise": "secure"})
    with pytest.raises(ValueError, match="replicas must be"):
        ReplicaBaseline(1)
    model = PPO("MlpPolicy", VecMonitor(make(4, 2)), n_steps=4, batch_size=16)
    with pytest.raises(ValueError, match="replicas must be the environment's 2, got 4"):
        model.learn(16, ReplicaBaseline(4))
    with pytest.raises(ValueError, match=r"for PPO and its kin, got .*DQN"):
        DQN("MlpPolicy", make(4, 2, action="sequential")).learn(16, ReplicaBaseline(2))
