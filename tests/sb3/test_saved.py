import io
import json
import zipfile
from importlib.resources import files

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from dptse_env import policies
from dptse_env.config import resolve
from dptse_env.interface import QueryInterface
from dptse_env.sb3 import (
    PlackettLucePolicy,
    RoadChannels,
    SB3VecEnv,
    load_policy,
    save_policy,
    saved,
    shipped_policies,
)

SHORT = "dptse_env:dptse/ShortHighway-v0"
ABOUT = {
    "env": SHORT,
    "keywords": {"estimator": "ekf"},
    "training": {"learner": "plackett-luce", "seed": 3, "steps": 100},
    "figures": {"error": 0.1234567890123},
}


def make_policy(action="slots", **keywords):
    config = resolve("short-highway", {"action": action, **keywords})
    interface = QueryInterface.of(config)
    spaces = interface.observations.space, interface.actions.space
    torch.manual_seed(0)
    if action == "slots":
        policy = PlackettLucePolicy(*spaces, road=RoadChannels.from_config(config), width=8)
    elif action == "sequential":
        maskable = pytest.importorskip("sb3_contrib.common.maskable.policies")
        policy = maskable.MaskableActorCriticPolicy(*spaces, lambda _: 1.0, net_arch=[16])
    else:
        policy = ActorCriticPolicy(*spaces, lambda _: 1.0, net_arch=[16])
    return policy, config


@pytest.fixture
def stored(tmp_path):
    policy, config = make_policy()
    save_policy(tmp_path / "one.zip", policy, config, **ABOUT)
    return tmp_path / "one.zip"


def make_env(**keywords):
    return gym.make(SHORT, **{"action": "slots", "traffic_seeds": "0:2", **keywords})


def observe(env):
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(30):
        observation = env.step(env.action_space.sample())[0]
    return observation


@pytest.mark.parametrize("action", ["slots", "scores", "mask", "sequential"])
def test_a_loaded_policy_acts_as_the_saved_one(tmp_path, action):
    policy, config = make_policy(action)
    save_policy(tmp_path / "one.zip", policy, config, **ABOUT)
    env = make_env(action=action)
    loaded = load_policy(tmp_path / "one.zip", env)
    seen = observe(env)
    batch = np.stack([seen, seen])
    extra = {}
    if action == "sequential":
        extra["action_masks"] = ~env.unwrapped.interface.actions.picked
    expected, _ = policy.predict(seen, deterministic=True, **extra)
    np.testing.assert_array_equal(loaded.predict(seen, deterministic=True)[0], expected)
    both, state = loaded.predict(batch, None, np.ones(2, bool), True)
    np.testing.assert_allclose(both, [expected, expected], atol=1e-6)
    assert state is None
    draws = []
    for one in (policy, loaded):
        torch.manual_seed(5)
        draws.append(one.predict(seen, **(extra if one is policy else {}))[0])
    np.testing.assert_array_equal(*draws)
    env.step(expected)


def test_a_masked_policy_never_picks_a_segment_twice(tmp_path):
    policy, config = make_policy("sequential", bandwidth=6)
    save_policy(tmp_path / "one.zip", policy, config, **ABOUT)
    env = make_env(action="sequential", bandwidth=6)
    loaded = load_policy(tmp_path / "one.zip", env)
    observation, _ = env.reset(seed=0)
    for _ in range(12):
        action, _ = loaded.predict(observation)
        observation, *_, info = env.step(action)
        assert info["n_dropped"] == 0


def test_it_is_loaded_for_any_form_of_the_environment(stored):
    vector = gym.make_vec(
        SHORT, num_envs=3, action="slots", traffic_seeds="0:2", autoreset_mode="SameStep"
    )
    for env in (make_env(), vector, SB3VecEnv(vector)):
        assert load_policy(stored, env).card["training"]["seed"] == 3
    assert load_policy(str(stored), vector).predict(vector.reset(seed=0)[0])[0].shape == (3, 2)
    with pytest.raises(ValueError, match="env must be an environment of this package"):
        load_policy(stored, gym.make("CartPole-v1"))


def test_the_file_is_small_and_says_what_it_is(stored):
    policy, config = make_policy()
    assert stored.stat().st_size < 100_000
    with zipfile.ZipFile(stored) as archive:
        assert sorted(archive.namelist()) == ["CARD.md", "card.json", "weights.pt"]
        assert {entry.date_time[0] for entry in archive.infolist()} == {1980}
        card = json.loads(archive.read("card.json"))
        text = archive.read("CARD.md").decode()
        weights = torch.load(io.BytesIO(archive.read("weights.pt")), weights_only=True)
    assert card["fits"]["corridor"] == config.corridor.digest
    assert card["fits"]["bandwidth"] == 2
    assert card["keywords"] == {"estimator": "ekf"}
    assert set(card["versions"]) == {"dptse-env", "stable-baselines3", "torch"}
    assert "ShortHighway-v0" in text
    assert "| error | 0.123457 |" in text
    assert weights.keys() == policy.state_dict().keys()


def test_the_same_policy_gives_the_same_file(stored, tmp_path):
    policy, config = make_policy()
    save_policy(tmp_path / "two.zip", policy, config, **ABOUT)
    assert (tmp_path / "two.zip").read_bytes() == stored.read_bytes()


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"bandwidth": 3}, r"bandwidth is 2 of the policy and 3 of the environment"),
        ({"action": "mask"}, r"action is 'slots' of the policy and 'mask' of the environment"),
        ({"incident": "none"}, r"corridor is '\w{64}' of the policy and '\w{64}' of the env"),
        ({"privacy": "guaranteed"}, r"observation is '.*released_speed:6.*released_flow:6"),
        ({"corridor": {"fixed_sensors": [5]}}, "observation is '.*fixed_speed_innovation:2"),
    ],
)
@pytest.mark.filterwarnings("ignore:privacy.preset")
def test_a_policy_that_does_not_fit_is_refused(stored, keywords, message):
    with pytest.raises(ValueError, match=message):
        load_policy(stored, make_env(**keywords))


def test_transfer_on_purpose(stored):
    env = make_env(bandwidth=3, incident="none", estimator="random_walk", epsilon=0.3)
    with pytest.raises(ValueError, match=r"corridor is .*allow=\('corridor',\)"):
        load_policy(stored, env, allow=("bandwidth",))
    policy = load_policy(stored, env, allow=("bandwidth", "corridor"))
    action, _ = policy.predict(observe(env), deterministic=True)
    assert len(set(action.tolist())) == 3
    with pytest.raises(ValueError, match="allow must be of corridor, bandwidth, got 'action'"):
        load_policy(stored, env, allow=("action",))


def test_another_format_is_refused(stored, monkeypatch):
    monkeypatch.setattr(saved, "VERSION", saved.VERSION + 1)
    with pytest.raises(ValueError, match="format is 'dptse-policy-1' of the policy and 'dptse-pol"):
        load_policy(stored, make_env())


def test_files_that_are_not_there_or_damaged(stored, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no saved policy '.*absent.zip': neither a file"):
        load_policy(tmp_path / "absent.zip", make_env())
    content = stored.read_bytes()
    for damaged in (b"", b"text", content[: len(content) // 2]):
        stored.write_bytes(damaged)
        with pytest.raises(ValueError, match="is no saved policy, or damaged"):
            load_policy(stored, make_env())


def rewritten(path, **entries):
    with zipfile.ZipFile(path) as archive:
        kept = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**kept, **entries}.items():
            archive.writestr(name, content)


def test_weights_that_run_code_or_are_missing(stored):
    evil, empty = io.BytesIO(), io.BytesIO()
    torch.save({"scorer.rule": print}, evil)
    torch.save({}, empty)
    rewritten(stored, **{"weights.pt": evil.getvalue()})
    with pytest.raises(ValueError, match="holds more than weights and is not loaded"):
        load_policy(stored, make_env())
    rewritten(stored, **{"weights.pt": empty.getvalue()})
    with pytest.raises(ValueError, match=r"lacks weights: .*scorer\.rule"):
        load_policy(stored, make_env())


def test_a_full_disk_leaves_the_old_file(stored, monkeypatch):
    before = stored.read_bytes()
    policy, config = make_policy(bandwidth=3)

    def full(path, content):
        path.open("wb").close()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        save_policy(stored, policy, config, **ABOUT)
    assert stored.read_bytes() == before
    assert [path.name for path in stored.parent.iterdir()] == ["one.zip"]


def test_what_cannot_be_saved(tmp_path):
    policy, config = make_policy()
    with pytest.raises(ValueError, match=r"path must end in \.zip"):
        save_policy(tmp_path / "one.pt", policy, config, **ABOUT)
    with pytest.raises(ValueError, match="policy must be one of PlackettLucePolicy"):
        save_policy(tmp_path / "one.zip", torch.nn.Linear(1, 1), config, **ABOUT)


def test_shipped_policies_are_loaded_by_name(stored, tmp_path, monkeypatch):
    folder = tmp_path / "policies"
    folder.mkdir()
    (folder / "short.zip").write_bytes(stored.read_bytes())
    monkeypatch.setattr(policies, "files", lambda package: tmp_path)
    assert shipped_policies() == ["short"]
    assert load_policy("short", make_env()).card["training"]["seed"] == 3
    with pytest.raises(FileNotFoundError, match=r"that come with the package \(short\)"):
        load_policy("long", make_env())


@pytest.mark.parametrize("name", shipped_policies())
def test_shipped_policies_act_where_they_were_trained(name):
    card = json.loads(
        zipfile.ZipFile(files("dptse_env") / "policies" / f"{name}.zip").read("card.json")
    )
    env = gym.make_vec(
        card["env"],
        num_envs=2,
        action=card["fits"]["action"],
        traffic_seeds="0:1",
        **card["keywords"],
    )
    policy = load_policy(name, env)
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        actions, _ = policy.predict(observation, deterministic=True)
        observation, *_, infos = env.step(actions)
        assert (infos["queried"].sum(axis=1) == env.config.bandwidth).all()
        assert not infos["n_dropped"].any()


def test_a_policy_comes_with_the_package():
    assert "private-highway" in shipped_policies()
