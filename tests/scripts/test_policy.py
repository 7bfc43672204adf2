"""``dptse policy import``: models of stable-baselines3 become saved policies."""

import json
import pickle

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


def words(folder, *more):
    return [
        "policy", "import", folder / "model.zip", "--env", SHORT,
        "--output", folder / "mine.safetensors", *more,
    ]  # fmt: skip


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
    done = run_command(*words(tmp_path, "--keywords", json.dumps(keywords), "--trust", *statistics))
    assert done.returncode == 0, done.stderr
    assert f"action encoding '{action}'" in done.stdout
    imported = load_policy(tmp_path / "mine.safetensors", env)
    assert imported.card["training"] == {"learner": "imported", "seed": 4, "steps": 0}
    assert not imported.deterministic
    seen, _ = env.reset(seed=1)
    expected, _ = model.predict(scaled.normalize_obs(seen), deterministic=True)
    np.testing.assert_array_equal(imported.predict(seen, deterministic=True)[0], expected)


def test_nothing_is_unpickled_without_the_users_word(tmp_path):
    (tmp_path / "model.zip").write_bytes(pickle.dumps(Bomb()))
    assert "trust must be given, since" in refused(*words(tmp_path))
    given = words(tmp_path, "--trust")  # everything else is looked at first
    assert "bandwidth must be" in refused(*given, "--keywords", '{"bandwidth": 9}')
    assert "env must be the id" in refused(*given, "--env", "nope")
    assert "bandwidth must be" in refused(*given, "--env", f'{SHORT} {{"bandwidth": 9}}')
    assert "must be a .safetensors file" in refused(*given, "--output", tmp_path / "mine.zip")
    assert not (tmp_path / "mine.safetensors").exists()


def test_what_cannot_be_imported_is_named(tmp_path):
    assert "there is no file" in refused(*words(tmp_path, "--trust"))
    save_model(tmp_path)
    (tmp_path / "bomb.pkl").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "three.pkl").write_bytes(pickle.dumps(3))
    for more, message in (
        (["--keywords", '{"bandwidth": 9}'], "bandwidth must be"),
        (
            ["--keywords", '{"corridor": "paper-highway"}'],
            "model.observation_space must be of shape",
        ),
        (["--keywords", '{"action": "mask"}'], "model.action_space must be MultiBinary"),
        (["--keywords", "[1]"], "keywords must be a JSON object"),
        (["--vecnormalize", tmp_path / "bomb.pkl"], "code of the file runs"),
        (["--vecnormalize", tmp_path / "three.pkl"], "must be a VecNormalize, got int"),
    ):
        assert message in refused(*words(tmp_path, "--trust", *more))
    (tmp_path / "model.zip").write_text("no archive")
    assert "model.zip cannot be read" in refused(*words(tmp_path, "--trust"))
    (tmp_path / "mine.safetensors").write_text("mine")
    assert "mine.safetensors" in refused(*words(tmp_path, "--trust"))
    assert (tmp_path / "mine.safetensors").read_text() == "mine"
