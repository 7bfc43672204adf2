"""Policies by name: saved ones, schedules, and classes."""

from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest

from agents.play import Cell
from agents.policies import find_policy
from dptse_env import sb3
from dptse_env.policies import TRANSFERABLE
from tests.helpers import ABOUT, SHORT, save_untrained, untrained
from tests.hostile import edited


def test_a_saved_policy_acts_as_it_did_where_it_fits(tmp_path):
    path = save_untrained(tmp_path / "policy.safetensors", seed=3)
    saved = find_policy(str(path))
    assert (saved.identity, saved.keywords) == (saved.card["sha256"], {"action": "slots"})
    assert saved.deterministic
    assert not saved.is_schedule
    env = gym.make(SHORT, action="slots")
    observation, _ = env.reset(seed=0)
    action, _ = saved.load(env).predict(observation, None, None, deterministic=True)
    expected, _ = sb3.load_policy(path, env).predict(observation, deterministic=True)
    np.testing.assert_array_equal(action, expected)
    other = gym.make(SHORT, action="slots", bandwidth=3)
    with pytest.raises(ValueError, match="bandwidth is 2 for the policy and 3 for the environment"):
        saved.load(other)
    saved.load(other, allow=TRANSFERABLE)


def test_its_environment_has_the_blocks_that_it_was_trained_on(tmp_path):
    path, blocks = tmp_path / "policy.safetensors", ["age", "speed"]
    policy, config = untrained("scores", observation=blocks)
    about = {**ABOUT, "keywords": {"observation": blocks}}
    sb3.save_policy(path, policy, config, **about)
    assert find_policy(str(path)).keywords == {"action": "scores", "observation": blocks}
    Cell(SHORT, str(path), {"bandwidth": 2, "horizon": 70}).check()
    about["keywords"]["observation"] = ["mine:Block"]
    sb3.save_policy(path, policy, config, **about)
    with pytest.raises(ValueError, match=r"keywords\.observation\[0\] must be a registered name"):
        find_policy(str(path)).keywords  # noqa: B018


def test_what_is_no_policy_is_refused(tmp_path):
    text = tmp_path / "text.zip"
    text.write_text("no weights")
    with pytest.raises(ValueError, match=r"text\.zip is no saved policy; dptse import policy"):
        find_policy(str(text))
    with pytest.raises(FileNotFoundError, match=r"none\.zip"):
        find_policy("none.zip")


class Slots:
    keywords: ClassVar = {"action": "slots"}

    def predict(self, observation):
        return np.zeros((*np.shape(observation)[:-1], 2), dtype=int)


class Wrong(Slots):
    keywords: ClassVar = {"privacy": "exact"}


def test_a_class_of_ones_own_names_its_actions_and_nothing_else():
    own = find_policy(f"{__name__}:Slots")
    assert own.keywords == {"action": "slots"}
    Cell(SHORT, f"{__name__}:Slots", {"horizon": 70}).check()
    with pytest.raises(ValueError, match=r":Wrong\.keywords must be of action and observation"):
        find_policy(f"{__name__}:Wrong").keywords  # noqa: B018


def test_a_card_without_recipe_and_training_seed_does(tmp_path):
    path = save_untrained(tmp_path / "policy.safetensors")
    path.write_bytes(edited(path, lambda card, weights: card.update(training={})))
    assert find_policy(str(path)).load(gym.make(SHORT, action="slots"))


def test_a_schedule_of_a_module_is_told_apart_by_its_code(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    for letter, rule in (("a", "OldestFirst"), ("b", "Random")):
        text = f"from dptse_env.schedules.rules import {rule} as Mine\n"
        (tmp_path / f"mine_{letter}.py").write_text(text)
    one, other = (find_policy(f"mine_{letter}:Mine").identity for letter in "ab")
    assert one.split()[0] == "mine_a:Mine"
    assert one.split()[1] != other.split()[1]
    with pytest.raises(ValueError, match="'mine_c:Mine' cannot be imported: ModuleNotFoundError"):
        find_policy("mine_c:Mine").identity  # noqa: B018
