"""Parts of another package: by name, by module and as objects, and bad ones."""

import json
import pickle
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dptse_env import register_part
from dptse_env.estimators import ESTIMATORS, Estimate, Estimator
from dptse_env.schedules import make_schedule
from dptse_env.spaces.rewards import REWARDS
from dptse_env.utils import registry
from tests.helpers import SHORT, assert_same, lock_step, play

sys.path.insert(0, str(Path(__file__).parent / "plugin"))

import dptse_plugin
from dptse_plugin import parts

KEYWORDS = [keyword for keyword in dptse_plugin.PARTS if keyword != "schedule"]


def by_module(keyword):
    return f"dptse_plugin.parts:{dptse_plugin.PARTS[keyword]}"


def as_object(keyword):
    return getattr(parts, dptse_plugin.PARTS[keyword])


def by_name(keyword):
    dptse_plugin.register()
    return f"plugin-{keyword}"


def keywords(form):
    values = {keyword: form(keyword) for keyword in KEYWORDS}
    return {
        **values,
        "observation": ["default", values["observation"]],
        "estimator_settings": {"weight": 0.5},
        "privacy": {"preset": values["privacy"], "scale": 5.0},
        "traffic_seeds": [0],
    }


@pytest.mark.parametrize("form", [by_name, by_module, as_object])
def test_every_part_serves_in_every_form(form):
    env = gym.make(SHORT, **keywords(form))
    seen = play(env, 20)
    info = env.unwrapped.privacy()
    assert info["preset"] == (form("privacy") if form is by_name else by_module("privacy"))
    # What it claims is shown, and voided by the boundary inputs, as for every model.
    assert (info["guarantee"], info["void_reasons"]) == ("none", ["boundary_inputs"])
    assert env.action_space == gym.spaces.Discrete(5)
    assert env.unwrapped.config.corridor.name == "plugin-road"
    assert "mean_density" in env.unwrapped.interface.observations.slices
    assert pickle.loads(pickle.dumps(env.unwrapped.config)) == env.unwrapped.config
    expected = play(gym.make(SHORT, **keywords(by_module)), 20)
    assert_same(seen, expected)
    plain = gym.make(SHORT, traffic_seeds=[0])
    schedule = make_schedule(form("schedule"), plain)
    assert schedule.predict(plain.reset(seed=0)[0])[0].sum() == 2
    assert make_schedule(schedule, plain) is schedule
    if form is not as_object:
        text = env.spec.to_json()
        assert json.loads(text)["kwargs"]["estimator"] == form("estimator")
        spec = gym.envs.registration.EnvSpec.from_json(text)
        assert_same(play(gym.make(spec), 20), seen)


def test_a_batch_is_so_many_single_episodes():
    lock_step(keywords(by_module), 8)


class Doubtful(parts.LaplaceRelease):
    claims_guarantee = True

    def report(self):
        return replace(super().report(), guarantee="none", void_reasons=("a_doubt_of_its_own",))


def test_a_claim_is_shown_as_it_is_made_and_a_reason_against_it_named():
    values = keywords(by_module)
    values["privacy"]["boundary_inputs"] = "nominal"
    privacy = gym.make(SHORT, **values).unwrapped.privacy()
    assert (privacy["guarantee"], privacy["void_reasons"]) == ("a claim", [])
    with pytest.warns(UserWarning, match="no privacy is guaranteed.* a_doubt_of_its_own"):
        gym.make(SHORT, privacy={"preset": Doubtful, "boundary_inputs": "nominal"})


def test_a_name_is_valid_and_stands_for_one_part():
    for arguments, message in (
        (("estimator", "ekf", parts.Smoothed), "estimator: 'ekf' ships with dptse_env"),
        (("estimator", "My Filter", parts.Smoothed), "a name must be lower-case letters"),
        (("estimators", "mine", parts.Smoothed), "keyword must be one of action, corridor, est"),
    ):
        with pytest.raises(ValueError, match=message):
            register_part(*arguments)
    register_part("reward", "cheap", parts.cheap_queries)
    register_part("reward", "cheap", parts.cheap_queries)
    assert REWARDS.name_of(parts.cheap_queries) == "cheap"
    with pytest.raises(ValueError, match="reward: 'cheap' is registered already, for another part"):
        register_part("reward", "cheap", lambda second: second.error.density)


def test_a_name_is_looked_for_among_installed_packages(monkeypatch):
    entry = EntryPoint("plugin", "dptse_plugin:register", "dptse_env.plugins")
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry][: group == entry.group])
    monkeypatch.setattr(registry, "_plugins_loaded", False)
    assert ESTIMATORS.find("plugin-estimator") is parts.Smoothed
    assert registry._plugins_loaded  # once a process


class NoUpdate(Estimator):
    def _reset(self): ...
    def _predict(self): ...
    def _estimate(self): ...


class Nan(parts.Smoothed):
    def _estimate(self):
        return Estimate(*[np.full_like(self.traffic[..., 0], np.nan)] * 4)


class Late(parts.Smoothed):
    """Sound until its first update."""

    def _update(self, episodes, measured):
        self.traffic[episodes] = np.inf


class WrongShape(parts.LaplaceRelease):
    def release(self, request):
        return super().release(request)._replace(values=np.zeros((1, 2)))


class Clash(parts.MeanDensity):
    name = "age"


class BlockOfNan(parts.MeanDensity):
    def values(self, state, task):
        return super().values(state, task) * np.nan


class TooMany(parts.Neighbours):
    def decode(self, episodes, actions, pending):
        decision = super().decode(episodes, actions, pending)
        decision.queried[:] = True
        return decision


def scalar_reward(second):
    return -1.0


HERE = __name__
LAPLACE = by_module("privacy")
UNKNOWN = {"estimator": parts.Smoothed, "estimator_settings": {"gain": 1}}
BAD = [
    ("make", {"estimator": "no_module:Filter"}, "estimator .* cannot be imported: ModuleNotFoundE"),
    ("make", {"estimator": f"{HERE}:Missing"}, f"estimator .* {HERE} has no 'Missing'; .*py"),
    ("make", {"estimator": LAPLACE}, r"estimator .* must be a subclass of dptse_env\.estimators"),
    ("make", {"estimator": NoUpdate}, r"estimator .*:NoUpdate must have _update\(\)"),
    ("make", {"privacy": NoUpdate}, r"privacy\.preset .*:NoUpdate must be a subclass of"),
    ("make", {"observation": ["default", Clash]}, "observation .*:Clash must not be named 'age'"),
    ("make", UNKNOWN, "estimator_settings.gain is unknown; allowed"),
    ("reset", {"estimator": Nan}, r"estimator .*:Nan.estimate\(\) must .* 'density' .* got nan in"),
    ("reset", {"observation": [BlockOfNan]}, r"observation .*BlockOfNan.values\(\) must .* finite"),
    ("reset", {"reward": scalar_reward}, r"reward .*:scalar_reward must .* shape \(1,\)"),
    ("step", {"estimator": Late}, r"estimator .*:Late.estimate\(\) must return finite floats"),
    ("step", {"privacy": WrongShape}, r"privacy.*WrongShape.release\(\) must .* \(1, 8, 2\)"),
    ("step", {"action": TooMany}, r"action .*:TooMany.decode\(\) must query at most 2"),
]


@pytest.mark.parametrize(("when", "values", "message"), BAD)
def test_bad_parts_are_refused_as_early_as_they_can_be_seen(when, values, message):
    if when == "make":
        with pytest.raises(ValueError, match=f"^{message}"):
            gym.make(SHORT, traffic_seeds=[0], **values)
        return
    env = gym.make(SHORT, traffic_seeds=[0], disable_env_checker=True, **values)
    if when == "step":
        env.reset(seed=0)
    with pytest.raises(ValueError, match=f"^{message}"):
        env.step(env.action_space.sample()) if when == "step" else env.reset(seed=0)
