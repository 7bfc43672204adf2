import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from dptse_env.sb3 import SB3VecEnv
from tests.helpers import SumRelease

SHORT = "dptse_env:dptse/ShortHighway-v0"
EPISODES = {"traffic_seeds": "0:3", "horizon": 6, "random_start": True}
ACTIONS = np.eye(3, 6, dtype=np.int8)


def make(num_envs=3, **keywords):
    keywords = {"autoreset_mode": "SameStep", **EPISODES, **keywords}
    return SB3VecEnv(gym.make_vec(SHORT, num_envs=num_envs, **keywords))


def dummy(**keywords):
    return DummyVecEnv([lambda: gym.make(SHORT, **EPISODES, **keywords)] * 3)


def assert_same_info(first, second):
    assert first.keys() == second.keys()
    for key, value in first.items():
        assert type(value) is type(second[key]), key
        if isinstance(value, dict):
            assert_same_info(value, second[key])
        elif isinstance(value, float | np.ndarray):
            np.testing.assert_allclose(value, second[key], rtol=0, atol=1e-10)
        else:
            assert value == second[key]


@pytest.mark.parametrize(
    ("action", "truth_in_info"),
    [("mask", True), ("scores", False), ("slots", True), ("sequential", False)],
)
def test_it_is_a_dummy_vec_env_of_scalar_environments(action, truth_in_info):
    keywords = {"action": action, "truth_in_info": truth_in_info, "privacy": "capped"}
    env, other = make(**keywords), dummy(**keywords)
    space = env.action_space
    assert (space, env.observation_space) == (other.action_space, other.observation_space)
    for one in (env, other):
        one.seed(4)
    np.testing.assert_allclose(env.reset(), other.reset(), rtol=0, atol=1e-10)
    space.seed(1)
    n_ended = 0
    for k in range(40):
        if k == 30:
            np.testing.assert_allclose(env.reset(), other.reset(), rtol=0, atol=1e-10)
        actions = np.array([space.sample() for _ in range(3)])
        (*here, infos), (*there, expected) = env.step(actions), other.step(actions)
        for value, wanted in zip(here, there, strict=True):
            assert value.dtype == wanted.dtype
            np.testing.assert_allclose(value, wanted, rtol=0, atol=1e-10)
        for info, reset, full, first, done in zip(
            infos, env.reset_infos, expected, other.reset_infos, here[2], strict=True
        ):
            assert_same_info(info, full if done else {})
            assert_same_info(reset, first)
            n_ended += done
    assert n_ended == (6 if action == "sequential" else 18)


def test_seeds_and_options_hold_for_one_reset():
    env = make(truth_in_info=True)
    env.seed(3)
    env.set_options([{"start": 7}, {"start": 9, "traffic_seed": 1}, {"start": 7}])
    env.reset()
    first = env.step(ACTIONS)[1]
    truths = [info["truth"] for info in env.reset_infos]
    assert [truth["time"] for truth in truths] == [7, 9, 7]
    assert truths[1]["traffic_seed"] == 1
    env.seed(3)
    env.set_options({"start": 11})
    env.reset()
    assert [info["truth"]["time"] for info in env.reset_infos] == [11] * 3
    starts = set()
    for _ in range(5):
        env.reset()
        starts |= {info["truth"]["time"] for info in env.reset_infos}
    assert len(starts) > 5
    assert (env.step(ACTIONS)[1] != first).all()


def test_options_that_are_refused():
    env = make()
    env.set_options({"reset_mask": np.ones(3, bool)})
    with pytest.raises(ValueError, match=r"options\.reset_mask is not for an SB3VecEnv"):
        env.reset()
    env.set_options({"stop": 3})
    with pytest.raises(ValueError, match=r"options\.stop is unknown"):
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
    assert not plain.has_attr("action_masks")
    with pytest.raises(AttributeError, match=r"needs action='sequential' or .*, got .*:MaskAction"):
        plain.env_method("action_masks")


def test_attributes():
    env = make()
    env.reset()
    assert env.get_attr("observation_space", indices=[0, 2]) == [env.observation_space] * 2
    assert env.get_attr("action_space") == [env.action_space] * 3
    assert env.get_attr("config", 0)[0].horizon == 6
    assert env.get_attr("np_random", [2]) == [env.env.np_random[2]]
    assert env.env_is_wrapped(Monitor) == [False] * 3
    assert not env.has_attr("nothing")
    with pytest.raises(AttributeError, match="horizon cannot be set"):
        env.set_attr("horizon", 3)
    with pytest.raises(AttributeError, match="env_method knows action_masks, got 'reset'"):
        env.env_method("reset")


def test_a_step_needs_actions_and_closing_twice_is_fine():
    env = make()
    env.reset()
    env.step(ACTIONS)
    with pytest.raises(RuntimeError, match="call step_async"):
        env.step_wait()
    env.close()
    env.close()


def test_another_autoreset_mode_is_refused():
    with pytest.raises(ValueError, match=r"autoreset_mode='SameStep', .* got 'NextStep'"):
        make(autoreset_mode="NextStep")


def test_other_environments_are_refused():
    keywords = {"autoreset_mode": "SameStep", **EPISODES}
    wrapped = gym.wrappers.vector.RecordEpisodeStatistics(gym.make_vec(SHORT, 2, **keywords))
    sync = gym.make_vec(SHORT, 2, vectorization_mode="sync", **EPISODES)
    for env in (wrapped, sync):
        with pytest.raises(ValueError, match="must be a bare SensorQueryVectorEnv, got"):
            SB3VecEnv(env)


def test_ppo_learns_and_is_evaluated():
    env = VecMonitor(make(4, action="sequential"))
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=32, n_epochs=2, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(256)
    assert model.num_timesteps == 256
    assert len(model.ep_info_buffer) == 20  # of 12 picks each, in 4 environments
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
    returns, lengths = evaluate_policy(model, env, 8, return_episode_rewards=True)
    assert lengths == [12] * 8
    assert np.isfinite(returns).all()
    assert max(returns) < 0


def test_sac_learns_from_terminal_observations():
    env = VecNormalize(VecMonitor(make(4, action="scores")))
    model = SAC("MlpPolicy", env, learning_starts=40, batch_size=16, seed=0, device="cpu")
    model.learn(120)
    kept = model.replay_buffer
    ends = kept.dones[:30].astype(bool)
    assert ends.sum() == 4 * 5
    # The end is a truncation, and what follows it in the buffer is the next episode's beginning.
    np.testing.assert_array_equal(kept.timeouts[:30], kept.dones[:30])
    assert (kept.next_observations[:29][ends[:29]] != kept.observations[1:30][ends[:29]]).any()
    assert (kept.next_observations[:29][~ends[:29]] == kept.observations[1:30][~ends[:29]]).all()


class DroppedPicks(BaseCallback):
    """Counts the picks that had been made before, in every decision of the training."""

    n_dropped = 0

    def _on_step(self):
        (process,) = self.training_env.get_attr("process", 0)
        self.n_dropped += process.n_dropped.sum()
        self.n_dropped += sum(info.get("n_dropped", 0.0) for info in self.locals["infos"])
        return True


@pytest.mark.parametrize(("algorithm", "masked"), [(MaskablePPO, True), (PPO, False)])
def test_maskable_ppo_never_picks_twice(algorithm, masked):
    env = VecMonitor(make(4, action="sequential", bandwidth=4))
    model = algorithm("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=2, seed=0, device="cpu")
    counter = DroppedPicks()
    model.learn(256, callback=counter)
    assert (counter.n_dropped == 0) == masked
    if masked:
        _, lengths = evaluate_masked(model, env, 8, return_episode_rewards=True)
        assert lengths == [24] * 8


def test_maskable_ppo_trains_where_decisions_take_different_numbers_of_actions():
    env = make(action="sequential", horizon=12, privacy=SumRelease, query_spans=(1, 2), bandwidth=3)
    model = MaskablePPO("MlpPolicy", env, n_steps=20, batch_size=30, seed=0)
    model.learn(60)
    assert model.num_timesteps == 60
    picks = model.rollout_buffer.actions[..., 0]
    assert set(np.unique(picks).astype(int)) <= set(range(11))
    assert not env.env.process.n_dropped.any()
