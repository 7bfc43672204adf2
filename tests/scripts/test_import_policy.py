"""``dptse import policy``: models of stable-baselines3 become saved policies."""

import json
import pickle
import shlex

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from dptse_env.sb3 import RoadPolicy, SB3VecEnv, load_policy
from tests.helpers import SHORT
from tests.scripts.commands import refused, run_command


class Bomb:
    """Runs code where it is unpickled."""

    def __reduce__(self):
        return exec, ("raise RuntimeError('code of the file runs')",)


def save_model(folder, action="scores", kind=PPO, policy="MlpPolicy", **keywords):
    """Save an untrained model and its statistics; return what they are of."""
    env = gym.make_vec(SHORT, num_envs=2, action=action, autoreset_mode="SameStep", **keywords)
    scaled = VecNormalize(SB3VecEnv(env), norm_obs=policy == "MlpPolicy")
    for _ in range(2):
        scaled.reset()
    more = RoadPolicy.kwargs(env) if policy is RoadPolicy else {}
    model = kind(policy, scaled, n_steps=8, batch_size=8, seed=4, policy_kwargs=more)
    model.save(folder / "model.zip")
    scaled.save(folder / "vecnormalize.pkl")
    return model, scaled, env


def words(folder, keywords=None, *more):
    env = f"{SHORT} {json.dumps(keywords or {})}"
    given = folder / "model.zip", "--env", env, "--output", folder / "mine"
    return ["import", "policy", *given, *more]


@pytest.mark.parametrize(
    ("action", "kind", "policy", "keywords"),
    [
        ("scores", PPO, "MlpPolicy", {"bandwidth": 3}),
        ("sequential", MaskablePPO, "MlpPolicy", {"bandwidth": 1}),
        ("slots", PPO, RoadPolicy, {"bandwidth": 3}),
    ],
)
def test_an_imported_model_acts_as_it_did(tmp_path, action, kind, policy, keywords):
    model, scaled, env = save_model(tmp_path, action, kind, policy, **keywords)
    statistics = ["--vecnormalize", tmp_path / "vecnormalize.pkl", "--acts", "drawn"]
    done = run_command(*words(tmp_path, keywords, "--trust", *statistics))
    assert done.returncode == 0, done.stderr
    assert f"action encoding '{action}'" in done.stdout
    path = tmp_path / "mine" / "policy.safetensors"
    given = shlex.quote(f"{SHORT} {json.dumps(keywords)}")
    assert f"next: dptse evaluate --env {given} --policies {path}\n" in done.stdout
    imported = load_policy(path, env)
    told = {"learner": "imported", "seed": 4, "steps": 0, "traffic seeds": "not said"}
    assert imported.card["training"] == told
    assert not imported.deterministic
    seen, _ = env.reset(seed=1)
    expected, _ = model.predict(scaled.normalize_obs(seen), deterministic=True)
    np.testing.assert_array_equal(imported.predict(seen, deterministic=True)[0], expected)


def test_nothing_is_unpickled_without_the_users_word(tmp_path):
    (tmp_path / "model.zip").write_bytes(pickle.dumps(Bomb()))
    assert "trust must be given, since" in refused(*words(tmp_path))
    assert not (tmp_path / "mine").exists()


def test_what_cannot_be_imported_is_named(tmp_path):
    save_model(tmp_path)
    (tmp_path / "bomb.pkl").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "three.pkl").write_bytes(pickle.dumps(3))
    for keywords, more, message in (
        ({"corridor": "paper-highway"}, [], "model.observation_space must be of shape"),
        ({"action": "mask"}, [], "model.action_space must be MultiBinary"),
        ({}, ["--vecnormalize", tmp_path / "bomb.pkl"], "code of the file runs"),
        ({}, ["--vecnormalize", tmp_path / "three.pkl"], "must be a VecNormalize, got int"),
    ):
        assert message in refused(*words(tmp_path, keywords, "--trust", *more))
    (tmp_path / "model.zip").write_text("no archive")
    assert "model.zip cannot be read" in refused(*words(tmp_path, {}, "--trust"))
    assert not (tmp_path / "mine").exists()


def test_a_policy_is_replaced_by_force_alone(tmp_path):
    *_, env = save_model(tmp_path)
    path = tmp_path / "mine" / "policy.safetensors"
    path.parent.mkdir()
    path.write_text("mine")
    assert str(path) in refused(*words(tmp_path, {}, "--trust"))
    assert path.read_text() == "mine"
    done = run_command(*words(tmp_path, {}, "--trust", "--force", "--quiet", "--json"))
    found = json.loads(done.stdout)
    assert (found["policy"], found["action"]) == (str(path), "scores")
    assert load_policy(path, env).card["training"]["learner"] == "imported"
