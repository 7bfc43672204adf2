import dataclasses

import pytest

pytest.importorskip("sb3_contrib")

import gymnasium as gym
import numpy as np
import torch

from agents.environments import make_vector
from agents.seeds import training_seed
from agents.training.policy_iteration import collect_swaps, raise_scores
from agents.training.recipes import SwapRounds
from agents.training.run_files import read_progress
from agents.training.training import BEST, POLICY, Training
from dptse_env.config import resolve
from dptse_env.sb3 import PlackettLucePolicy, RoadChannels
from tests.agents.training.plans import (
    FEW_SWAPS,
    StopError,
    make_plan,
    stop_at,
    without_time,
)

SEED = 1
KEYWORDS = {"horizon": 80, "privacy": "capped", "action": "slots", "traffic_seeds": "0:3"}


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [0, 1, 2])
def test_a_training_killed_between_rounds_continues_alike(stopped, trained, tmp_path):
    plan, complete = make_plan(), trained()
    broken = Training(plan, tmp_path / "broken", watchers=(stop_at(stopped),))
    with pytest.raises(StopError):
        broken.run()
    torch.manual_seed(99)
    again = Training(plan, tmp_path / "broken")
    assert again.update == max(stopped - 1, 0)
    again.run()
    assert again.is_finished
    assert without_time(again.rows) == without_time(complete.rows)
    for name in (POLICY, BEST):
        assert (again.folder / name).read_bytes() == (complete.folder / name).read_bytes()


def test_the_curve_of_rounds(trained):
    training = trained()
    reports, rows = training.reports, read_progress(training.folder)
    assert [row["update"] for row in rows] == [0, 1, 2]
    # Four episodes are simulated for nine seconds ahead of the rounds; in a round three of 80 s,
    # each with 1 + 2 forks under noise and its opposite.
    assert [row["steps"] for row in rows] == [36, 36 + 1680, 36 + 2 * 1680]
    assert all(0.01 < row["validation"] < 1 for row in rows)
    assert all(0.01 < row["validation_drawn"] < 1 for row in rows)
    assert all(0.01 < row["error"] < 1 for row in rows[1:])
    stages = [stage for stage, _ in reports]
    assert list(dict.fromkeys(stages)) == ["regression", "swaps", "fit"]
    assert all(0.0 <= fraction <= 1.0 for _, fraction in reports)


def make_policy():
    env = gym.make("dptse_env:dptse/ShortHighway-v0", **KEYWORDS)
    road = RoadChannels.from_config(resolve("short-highway", {"privacy": "capped"}))
    torch.manual_seed(0)
    return PlackettLucePolicy(env.observation_space, env.action_space, road=road, width=8)


def make_batch():
    return make_vector("dptse_env:dptse/ShortHighway-v0", FEW_SWAPS.episodes, KEYWORDS)


def ignore(stage, fraction):
    pass


def weights_after(settings, index):
    policy = make_policy()
    swaps = collect_swaps(policy, make_batch(), settings, index, SEED, ignore)
    raise_scores([policy], [swaps], settings, settings.step_of(index))
    return torch.nn.utils.parameters_to_vector(policy.parameters()).detach().numpy()


@pytest.mark.slow
def test_steps_fall_from_round_to_round():
    settings = dataclasses.replace(FEW_SWAPS, step=9.0, final_step=1.0)
    first, last = (weights_after(settings, index) for index in (0, 1))
    other_end = dataclasses.replace(settings, final_step=2.0)
    other_start = dataclasses.replace(settings, step=8.0)
    np.testing.assert_array_equal(weights_after(other_end, 0), first)
    np.testing.assert_array_equal(weights_after(other_start, 1), last)
    assert (weights_after(other_start, 0) != first).any()
    assert (weights_after(other_end, 1) != last).any()
    assert SwapRounds(rounds=5, step=9.0, final_step=1.0).step_of(1) == pytest.approx(7.0)
    assert SwapRounds(rounds=1).step_of(0) == SwapRounds().step


class Seeds:
    """An environment that remembers the seeds of its episodes."""

    def __init__(self, env):
        self.env, self.seeds = env, set()

    def __getattr__(self, name):
        return getattr(self.env, name)

    def reset(self, *, seed):
        self.seeds |= set(seed)
        return self.env.reset(seed=seed)


def test_every_round_tries_other_swaps_in_other_episodes():
    policy, env = make_policy(), make_batch()
    seeds, rounds = [], []
    for index in (0, 1):
        episodes = Seeds(env)
        torch.manual_seed(0)
        rounds.append(collect_swaps(policy, episodes, FEW_SWAPS, index, SEED, ignore))
        seeds.append(episodes.seeds)
    assert [len(of_a_round) for of_a_round in seeds] == [3, 3]
    assert not seeds[0] & seeds[1]
    assert min(seeds[0] | seeds[1]) > training_seed(SEED) + make_plan().recipe.n_envs
    assert max(seeds[0] | seeds[1]) < training_seed(SEED + 1)
    # 80 s less the first of 20 to 24 leave eleven or twelve states of three episodes.
    assert {len(swaps.observations) for swaps in rounds} <= {33, 36}
    assert all(len(swaps.gain) == 2 * len(swaps.observations) for swaps in rounds)
    n = min(len(swaps.added) for swaps in rounds)
    assert (rounds[0].added[:n] != rounds[1].added[:n]).any()
