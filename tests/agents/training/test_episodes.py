import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from agents.training.episodes import TrainingEpisodes
from dptse_env.sb3 import SB3VecEnv
from dptse_env.spaces.actions import ACTION_ENCODINGS

HORIZON = 20


def make(num_envs=4, seed=3, replicas=1, reward_scale=1.0, **keywords):
    keywords = {"traffic_seeds": "0:3", "horizon": HORIZON, "random_start": True, **keywords}
    env = gym.make_vec(
        "dptse_env:dptse/ShortHighway-v0",
        num_envs=num_envs,
        autoreset_mode="SameStep",
        privacy="capped",
        **keywords,
    )
    return TrainingEpisodes(SB3VecEnv(env), seed, replicas=replicas, reward_scale=reward_scale)


def play(episodes, steps, generator):
    """Random actions; return everything that came back."""
    space, n = episodes.action_space, episodes.num_envs
    space.seed(int(generator.integers(2**31)))
    return [episodes.step(np.array([space.sample() for _ in range(n)])) for _ in range(steps)]


def assert_same(first, second):
    for one, other in zip(first, second, strict=True):
        for value, wanted in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(value, wanted)
        for info, expected in zip(one[3], other[3], strict=True):
            assert info.keys() == expected.keys()
            if "terminal_observation" in info:
                np.testing.assert_array_equal(
                    info["terminal_observation"], expected["terminal_observation"]
                )


def test_episodes_are_spread_over_time_and_then_complete():
    episodes = make()
    episodes.reset()
    transitions = play(episodes, 3 * HORIZON, np.random.default_rng(0))
    ends = np.array([dones for _, _, dones, _ in transitions])
    after = [np.flatnonzero(ends[:, e]) + 1 for e in range(4)]
    assert [times.tolist() for times in after] == [
        [20, 40, 60], [5, 25, 45], [10, 30, 50], [15, 35, 55],
    ]  # fmt: skip
    for observation, _, dones, infos in transitions:
        for e, info in enumerate(infos):
            assert ("terminal_observation" in info) == dones[e]
            if dones[e]:
                assert info["TimeLimit.truncated"]
                assert (info["terminal_observation"] != observation[e]).any()


@pytest.mark.parametrize("steps", [0, 1, 7, 20, 33, 60, 65])
@pytest.mark.parametrize("action", ACTION_ENCODINGS)
def test_a_kept_state_is_continued_to_the_same_bits(action, steps):
    episodes = make(action=action)
    episodes.reset()
    seen = play(episodes, steps, np.random.default_rng(0))
    state = {key: value.copy() for key, value in episodes.state().items()}
    other = make(action=action)
    observation = other.restore(state)
    if seen:
        np.testing.assert_array_equal(observation, seen[-1][0])
    first, second = (play(e, 45, np.random.default_rng(1)) for e in (episodes, other))
    assert_same(first, second)
    for key, value in episodes.state().items():
        np.testing.assert_array_equal(other.state()[key], value)


def test_another_seed_gives_other_traffic_and_noise():
    first, second = (play(make_reset(seed), 5, np.random.default_rng(0)) for seed in (3, 30))
    assert all((a[0] != b[0]).any() for a, b in zip(first, second, strict=True))


def make_reset(seed, **keywords):
    episodes = make(seed=seed, **keywords)
    episodes.reset()
    return episodes


def test_replicas_meet_the_same_traffic_and_noise():
    episodes = make(num_envs=6, replicas=3, action="slots")
    episodes.reset()
    same = np.tile([[0, 3]], (6, 1))
    for _ in range(2 * HORIZON + 3):
        observation, rewards, dones, _ = episodes.step(same)
        for value in (observation, rewards, dones):
            groups = value.reshape(2, 3, -1)
            assert (groups == groups[:, :1]).all()
        assert dones.all() or (observation[0] != observation[3]).any()
    apart = same.copy()
    apart[1] = [1, 4]
    rewards = episodes.step(apart)[1]
    assert rewards[0] == rewards[2] != rewards[1]


def test_recentred_advantages_are_compared_with_the_replicas():
    episodes = make(num_envs=4, replicas=2)
    advantages = np.arange(8, dtype=np.float32).reshape(2, 4) ** 2
    episodes.recentre(advantages)
    assert advantages.tolist() == [[-1, 1, -5, 5], [-9, 9, -13, 13]]
    alone = np.ones((2, 4), dtype=np.float32)
    make(num_envs=4).recentre(alone)
    assert (alone == 1).all()


def test_rewards_are_scaled_and_their_mean_is_not():
    scaled, plain = make(reward_scale=0.25, action="slots"), make(action="slots")
    rewards = []
    for episodes in (scaled, plain):
        episodes.reset()
        rewards.append(np.array([row[1] for row in play(episodes, 9, np.random.default_rng(0))]))
    np.testing.assert_allclose(rewards[0], 0.25 * rewards[1], rtol=1e-6)
    assert scaled.take_mean_reward() == pytest.approx(rewards[1].mean(), rel=1e-5)
    assert np.isnan(scaled.take_mean_reward())


def test_the_mean_is_that_of_a_second_where_a_decision_takes_several_actions():
    episodes = make(action="sequential", bandwidth=3)
    episodes.reset()
    rewards = np.array([row[1] for row in play(episodes, 9, np.random.default_rng(0))])
    assert (rewards[[0, 1, 3, 4]] == 0).all()
    assert episodes.take_mean_reward() == pytest.approx(rewards[2::3].mean(), rel=1e-5)


def test_a_number_of_episodes_that_replicas_do_not_divide_is_refused():
    with pytest.raises(ValueError, match="multiple of replicas 3, got 4"):
        make(replicas=3)
