"""Ids: each is made without a warning, has its encoding, and says its number of steps."""

import re
import warnings

import gymnasium as gym
import pytest

from dptse_env.registration import ENCODINGS, ENVIRONMENTS, encoded
from tests.helpers import EPISODES, ROOT, SHORT

IDS = dict.fromkeys(ENVIRONMENTS, "mask")
IDS |= {
    encoded(env, suffix): action for env in ENVIRONMENTS for suffix, action in ENCODINGS.items()
}
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.py")]


@pytest.mark.parametrize("name", IDS)
def test_an_id_gives_no_warning_and_has_its_encoding(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(f"dptse_env:{name}")
        assert gym.make_vec(f"dptse_env:{name}", num_envs=2).config == env.unwrapped.config
    assert env.unwrapped.config.action == IDS[name]
    assert gym.make(f"dptse_env:{name}", action="slots").unwrapped.config.action == "slots"


def test_all_ids_of_the_package_are_those_of_the_table():
    assert {name for name in gym.registry if name.startswith("dptse/")} == {*IDS}


BRIEF = {**EPISODES, "horizon": 5}
LENGTHS = {
    "one action a second": (BRIEF, 5),
    "several actions a second": ({**BRIEF, "action": "sequential", "bandwidth": 3}, 15),
    "a decision in several seconds": ({**BRIEF, "query_every": 2}, 3),
    "both": ({**BRIEF, "query_every": 2, "action": "sequential", "bandwidth": 2}, 6),
    "spans": ({**BRIEF, "privacy": "paced", "epsilon": 5, "query_spans": [1, 2]}, 5),
    "the record": ({"traffic_seeds": [0]}, 240),
}


@pytest.mark.parametrize(("keywords", "n_steps"), LENGTHS.values(), ids=LENGTHS)
def test_the_spec_says_how_many_steps_there_are(keywords, n_steps):
    env, batch = gym.make(SHORT, **keywords), gym.make_vec(SHORT, num_envs=2, **keywords)
    for each in (env, batch):
        assert steps_of(each) == each.spec.max_episode_steps == n_steps
    assert steps_of(gym.make(env.spec)) == n_steps  # with Gymnasium's time limit
    assert steps_of(gym.make_vec(env.spec, num_envs=2)) == n_steps


def steps_of(env):
    """Return the number of steps of an episode of random actions."""
    env.reset(seed=0)
    env.action_space.seed(0)
    for step in range(1, 1000):
        *_, truncated, _ = env.step(env.action_space.sample())
        if truncated if isinstance(truncated, bool) else truncated.any():
            return step
    raise AssertionError("does not end")


LONGER = {"corridor": {"duration": 250, "incident": None}, "traffic_seeds": [0]}


@pytest.mark.parametrize("keywords", [LONGER, {**LONGER, "horizon": 245}])
def test_another_road_and_a_longer_horizon_are_not_cut(keywords):
    n_steps = keywords.get("horizon", 250)
    assert n_steps > gym.make(SHORT).spec.max_episode_steps
    for env in (gym.make(SHORT, **keywords), gym.make_vec(SHORT, num_envs=1, **keywords)):
        assert steps_of(env) == n_steps


def test_where_actions_decide_on_the_number_of_steps_the_spec_has_none():
    spans = {"privacy": "paced", "epsilon": 5, "query_spans": [1, 2], "action": "sequential"}
    for env in (gym.make(SHORT, **spans), gym.make_vec(SHORT, num_envs=1, **spans)):
        assert env.spec.max_episode_steps is None


def test_a_batch_refuses_another_number_of_steps():
    with pytest.raises(ValueError, match=r"max_episode_steps must be 240, .* horizon .*, got 9"):
        gym.make_vec(SHORT, num_envs=1, max_episode_steps=9)


def test_the_pages_name_ids_that_there_are():
    named = {
        name
        for page in PAGES
        if page.name != "CHANGELOG.md"
        for name in re.findall(r"\bdptse/[\w-]+-v\d+", page.read_text(encoding="utf-8"))
    }
    assert "dptse/PaperHighway-v0" in named
    assert named <= {*IDS}
