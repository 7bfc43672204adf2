import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from agents.training.episodes import TrainingEpisodes, make_episodes, recentre
from dptse_env.sb3 import SB3VecEnv
from tests.agents.training.plans import make_plan
from tests.helpers import SHORT

HORIZON = 20


def make(num_envs=4, replicas=1, **keywords):
    keywords = {"traffic_seeds": "0:3", "horizon": HORIZON, "random_start": True, **keywords}
    env = gym.make_vec(
        SHORT, num_envs=num_envs, autoreset_mode="SameStep", privacy="capped", **keywords
    )
    episodes = TrainingEpisodes(SB3VecEnv(env), 3, replicas)
    episodes.reset()
    return episodes


@pytest.mark.parametrize(("action", "per_second"), [("slots", 1), ("sequential", 2)])
def test_episodes_are_spread_over_time_and_then_complete(action, per_second):
    episodes = make(action=action)
    space = episodes.action_space
    space.seed(0)
    ends = []
    for _ in range(3 * HORIZON * per_second):
        observation, _, dones, infos = episodes.step(np.array([space.sample() for _ in range(4)]))
        ends.append(dones)
        for e, info in enumerate(infos):
            assert ("terminal_observation" in info) == dones[e]
            if dones[e]:
                assert info["TimeLimit.truncated"]
                assert (info["terminal_observation"] != observation[e]).any()
    after = [np.flatnonzero(of_one) + 1 for of_one in np.transpose(ends)]
    assert [(times / per_second).tolist() for times in after] == [
        [20, 40, 60], [5, 25, 45], [10, 30, 50], [15, 35, 55],
    ]  # fmt: skip


def test_replicas_meet_the_same_traffic_and_noise():
    episodes = make(num_envs=6, replicas=3, action="slots")
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
    advantages = np.arange(8, dtype=np.float32).reshape(2, 4) ** 2
    alone = advantages.copy()
    recentre(alone, 1)
    assert (alone == advantages).all()
    recentre(advantages, 2)
    assert advantages.tolist() == [[-1, 1, -5, 5], [-9, 9, -13, 13]]


def test_trainings_and_their_continuations_have_episodes_of_their_own():
    def seen(seed, update):
        plan = make_plan(seed=seed)
        keywords = {"action": "slots", "traffic_seeds": [0, 1, 2]}
        episodes = make_episodes(plan, plan.worlds[0], keywords, update)
        episodes.reset()
        for _ in range(5):
            observation = episodes.step(np.tile([[0, 3]], (4, 1)))[0]
        return observation[0].tobytes()

    assert seen(1, 0) == seen(1, 0)
    assert len({seen(1, 0), seen(2, 0), seen(1, 1)}) == 3


def test_a_number_of_episodes_that_replicas_do_not_divide_is_refused():
    with pytest.raises(ValueError, match="multiple of replicas 3, got 4"):
        make(replicas=3)
