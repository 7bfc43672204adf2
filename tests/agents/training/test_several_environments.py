"""One network that learns from several environments."""

import json
import re

import pytest

pytest.importorskip("sb3_contrib")

import gymnasium as gym
import torch

from agents.training.training import BEST, POLICY, Training
from dptse_env.sb3 import load_policy
from tests.agents.training.plans import StopError, make_plan, stop_at, without_time

SHORT = "dptse_env:dptse/ShortHighway-v0"
HIGHWAY = "dptse_env:dptse/PrivateHighway-v0"
OTHER = f'{HIGHWAY} {{"horizon": 80, "bandwidth": 3}}'
"""A road of 15 segments beside one of 6; both have one kind of channels."""


@pytest.fixture(scope="module")
def joint(tmp_path_factory):
    training = Training(make_plan(also=(OTHER,)), tmp_path_factory.mktemp("joint"))
    training.run()
    return training


def test_policies_have_their_weights_in_common_and_roads_of_their_own(joint):
    first, second = joint.learner.policies
    assert first.scorer is second.scorer
    assert (first.road.n_mainline, first.bandwidth) == (6, 2)
    assert (second.road.n_mainline, second.bandwidth) == (15, 3)


def test_another_environment_changes_what_is_learned(joint, trained):
    alone = trained().learner.policy.state_dict()
    assert not all(torch.equal(alone[k], v) for k, v in joint.learner.policy.state_dict().items())


def test_longer_roads_get_fewer_episodes(joint):
    first, second = joint.plan.worlds
    assert (first.part(100), second.part(100)) == (100, 40)
    assert second.part(4, 2) == 2
    assert second.part(1) == 1
    regression, forks = 9, 1 + 2 * (1 + 2)
    rounds = 2 * (3 + 1) * 80 * forks
    assert joint.plan.steps_at(2) == regression * (4 + 2) + rounds


def test_the_policy_acts_in_both_environments_and_its_card_names_them(joint):
    card = load_policy(
        joint.folder / POLICY,
        gym.make(SHORT, action="slots", privacy="capped", horizon=80),
    ).card
    assert card["training"]["also"] == [OTHER]
    for column, kind in (("validation", "deterministic"), ("validation_drawn", "drawn")):
        errors = [
            value for key, value in card["figures"].items() if re.match(f"error in .*{kind}", key)
        ]
        assert len(errors) == 2
        assert joint.rows[-1][column] == pytest.approx(sum(errors) / 2)
    env = gym.make(HIGHWAY, action="slots", bandwidth=3, horizon=80)
    policy = load_policy(joint.folder / BEST, env, allow=("corridor", "bandwidth"))
    observation, _ = env.reset(seed=0)
    assert env.action_space.contains(policy.predict(observation)[0])
    plan = json.loads((joint.folder / "plan.json").read_text())
    assert plan["also"] == [OTHER]
    assert len(set(plan["corridors"])) == 2


@pytest.mark.slow
def test_a_killed_training_continues_to_the_same_curve(joint, tmp_path):
    broken = Training(make_plan(also=(OTHER,)), tmp_path, watchers=(stop_at(2),))
    with pytest.raises(StopError):
        broken.run()
    again = Training(make_plan(also=(OTHER,)), tmp_path)
    again.run()
    assert without_time(again.rows) == without_time(joint.rows)
    for name in (POLICY, BEST):
        assert (tmp_path / name).read_bytes() == (joint.folder / name).read_bytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"also": (f"{SHORT} 3",)}, "keywords must be a JSON object"),
        ({"also": (f'{SHORT} {{"action": "mask"}}',)}, r"keywords\.action is chosen by"),
        ({"learner": "mask", "also": (OTHER,)}, "also must be empty for mask, whose network"),
        (
            {"also": (f'{SHORT} {{"privacy": "paced"}}',)},
            r"also: .*ShortHighway-v0 .*: environments must have the same channels .*price",
        ),
    ],
)
def test_environments_that_do_not_suit_are_refused(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Training(make_plan(**changes), tmp_path / "run")
