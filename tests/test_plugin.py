"""Parts of another package: by name, by module and as objects, and bad ones."""

import json
import pickle
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dptse_env import register_part
from dptse_env.estimators import Estimate
from dptse_env.registration import REGISTRIES
from dptse_env.schedules import make_schedule

SHORT = "dptse_env:dptse/ShortHighway-v0"
SOURCE = str(Path(__file__).parent / "plugin")
sys.path.insert(0, SOURCE)

import dptse_plugin  # noqa: E402
from dptse_plugin import parts  # noqa: E402

KEYWORDS = [keyword for keyword in dptse_plugin.PARTS if keyword != "schedule"]


@pytest.fixture(autouse=True)
def registries(monkeypatch):
    """Forget at the end of a test what it has registered."""
    for path in REGISTRIES.values():
        module, _, attribute = path.partition(":")
        registry = getattr(import_module(module), attribute)
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))


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


def rollout(env, n_steps=20):
    env.action_space.seed(3)
    observation, info = env.reset(seed=2)
    seen = [(observation, info)]
    for _ in range(n_steps):
        observation, reward, *_, info = env.step(env.action_space.sample())
        seen.append((observation, reward, info))
    return seen


def same(first, second):
    for one, other in zip(first, second, strict=True):
        for a, b in zip(one[:-1], other[:-1], strict=True):
            np.testing.assert_array_equal(a, b)
    return True


@pytest.mark.parametrize("form", [by_name, by_module, as_object])
def test_every_part_serves_in_every_form(form):
    env = gym.make(SHORT, **keywords(form))
    seen, expected = rollout(env), rollout(gym.make(SHORT, **keywords(by_module)))
    assert same(seen, expected)
    assert env.action_space == gym.spaces.Discrete(5)
    assert env.unwrapped.config.corridor.name == "plugin-road"
    assert "mean_density" in env.unwrapped.interface.observations.slices
    privacy = seen[0][1]["privacy"]
    name = form(keyword="privacy") if form is by_name else "dptse_plugin.parts:LaplaceRelease"
    assert privacy["preset"] == name
    # What it claims is shown, and voided by the boundary inputs, as for every model.
    assert (privacy["guarantee"], privacy["void_reasons"]) == ("none", ["boundary_inputs"])


def test_a_claim_is_shown_as_it_is_made():
    values = keywords(by_module)
    values["privacy"]["boundary_inputs"] = "nominal"
    privacy = gym.make(SHORT, **values).reset(seed=0)[1]["privacy"]
    assert (privacy["guarantee"], privacy["void_reasons"]) == ("a claim", [])


class Doubtful(parts.LaplaceRelease):
    claims_guarantee = True

    def report(self):
        return replace(super().report(), guarantee="none", void_reasons=("a_doubt_of_its_own",))


def test_a_reason_of_ones_own_against_a_guarantee_is_named():
    with pytest.warns(UserWarning, match="no privacy is guaranteed.* a_doubt_of_its_own"):
        gym.make(SHORT, privacy={"preset": Doubtful, "boundary_inputs": "nominal"})


@pytest.mark.parametrize("form", [by_name, by_module])
def test_strings_survive_the_spec(form):
    env = gym.make(SHORT, **keywords(form))
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert json.loads(env.spec.to_json())["kwargs"]["estimator"] == form("estimator")
    assert same(rollout(gym.make(spec)), rollout(gym.make(SHORT, **keywords(form))))
    copy = pickle.loads(pickle.dumps(env.unwrapped.config))
    assert copy == env.unwrapped.config


@pytest.mark.parametrize("form", [by_module, as_object])
def test_a_batch_is_so_many_single_episodes(form):
    batch = gym.make_vec(SHORT, num_envs=2, **keywords(form))
    actions = np.array([1, 3])
    observation, _ = batch.reset(seed=4)
    for episode in range(2):
        env = gym.make(SHORT, **keywords(form))
        np.testing.assert_array_equal(env.reset(seed=4 + episode)[0], observation[episode])
    after = [batch.step(actions)[0] for _ in range(5)][-1]
    for episode in range(2):
        env = gym.make(SHORT, **keywords(form))
        env.reset(seed=4 + episode)
        alone = [env.step(actions[episode])[0] for _ in range(5)][-1]
        np.testing.assert_array_equal(alone, after[episode])


@pytest.mark.slow
def test_spawned_workers_know_modules(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", SOURCE)
    envs = gym.make_vec(
        SHORT,
        num_envs=2,
        vectorization_mode="async",
        vector_kwargs={"context": "spawn"},
        **keywords(by_module),
    )
    try:
        envs.reset(seed=0)
        assert np.isfinite(envs.step(envs.action_space.sample())[1]).all()
    finally:
        envs.close()


def test_a_schedule_of_another_package():
    env = gym.make(SHORT, traffic_seeds=[0])
    observation, _ = env.reset(seed=0)
    for form in (by_name, by_module, as_object):
        schedule = make_schedule(form("schedule"), env)
        action, _ = schedule.predict(observation)
        assert action.sum() == 2
        assert make_schedule(schedule, env) is schedule


# --- names ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("estimator", "ekf", parts.Smoothed), "estimator: 'ekf' ships with dptse_env"),
        (("privacy", "capped", parts.LaplaceRelease), "'capped' ships with dptse_env"),
        (("estimator", "My Filter", parts.Smoothed), "a name must be lower-case letters"),
        (("estimators", "mine", parts.Smoothed), "keyword must be one of action, corridor, est"),
    ],
)
def test_names_that_cannot_be_registered(arguments, message):
    with pytest.raises(ValueError, match=message):
        register_part(*arguments)


def test_a_name_stands_for_one_part():
    register_part("reward", "cheap", parts.cheap_queries)
    register_part("reward", "cheap", parts.cheap_queries)
    with pytest.raises(ValueError, match="reward: 'cheap' is registered already, for another part"):
        register_part("reward", "cheap", lambda second: second.error.density)


# --- bad parts --------------------------------------------------------------------------------


class NoUpdate:
    def reset(self): ...
    def predict(self): ...
    def estimate(self): ...


class NoInnovations(NoUpdate):
    is_compiled = False

    def __init__(self, model, n_episodes, settings):
        self.n_episodes = n_episodes

    def update(self): ...


class Nan(parts.Smoothed):
    def estimate(self):
        return Estimate(*[np.full_like(self.traffic[..., 0], np.nan)] * 4)


class Late(parts.Smoothed):
    """Sound until its first update."""

    def _update(self, episodes, measured):
        self.traffic[episodes] = np.inf


class WrongShape(parts.LaplaceRelease):
    def release(self, request):
        return super().release(request)._replace(values=np.zeros((1, 2)))


class NanRelease(parts.LaplaceRelease):
    def release(self, request):
        released = super().release(request)
        return released._replace(values=released.values * np.nan)


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


HERE = "tests.test_plugin"
WHEN_MADE = [
    (
        {"estimator": "no_such_module:Filter"},
        r"^estimator .* cannot be imported: ModuleNotFoundErr",
    ),
    ({"estimator": f"{HERE}:Missing"}, rf"^estimator .* {HERE} has no 'Missing'"),
    ({"estimator": NoUpdate}, rf"^estimator {HERE}:NoUpdate must have update\(\)"),
    ({"privacy": NoUpdate}, rf"^privacy\.preset {HERE}:NoUpdate must be a subclass of"),
    ({"observation": ["default", Clash]}, rf"^observation {HERE}:Clash must not be named 'age'"),
    ({"estimator": parts.Smoothed, "estimator_settings": {"gain": 1}}, r"gain is unknown; allowed"),
]
AT_RESET = [
    ({"estimator": NoInnovations}, rf"^estimator {HERE}:NoInnovations must have .* 'innovations'"),
    (
        {"estimator": Nan},
        rf"^estimator {HERE}:Nan.estimate\(\) must return finite floats 'density'",
    ),
    ({"observation": [BlockOfNan]}, rf"^observation {HERE}:BlockOfNan.values\(\) must .* finite"),
    ({"reward": scalar_reward}, rf"^reward {HERE}:scalar_reward must .* shape \(1,\)"),
]
AT_STEP = [
    ({"estimator": Late}, rf"^estimator {HERE}:Late.estimate\(\) must return finite floats"),
    (
        {"privacy": WrongShape},
        rf"^privacy\.preset {HERE}:WrongShape.release\(\) must .* \(1, 8, 2\)",
    ),
    ({"privacy": NanRelease}, rf"^privacy\.preset {HERE}:NanRelease.release\(\) must .* finite"),
    ({"action": TooMany}, rf"^action {HERE}:TooMany.decode\(\) must query at most 2"),
]


@pytest.mark.parametrize(("values", "message"), WHEN_MADE)
def test_bad_parts_are_refused_when_the_environment_is_made(values, message):
    with pytest.raises(ValueError, match=message):
        gym.make(SHORT, traffic_seeds=[0], **values)


@pytest.mark.parametrize(("values", "message"), AT_RESET)
def test_bad_parts_are_refused_at_the_first_reset(values, message):
    env = gym.make(SHORT, traffic_seeds=[0], **values)
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0)


@pytest.mark.parametrize(("values", "message"), AT_STEP)
def test_bad_parts_are_refused_in_the_step_in_which_they_fail(values, message):
    env = gym.make(SHORT, traffic_seeds=[0], disable_env_checker=True, **values)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(env.action_space.sample())
