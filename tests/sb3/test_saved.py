import io
import json
import zipfile
from importlib.resources import files

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from dptse_env.config import resolve
from dptse_env.parts import make_interface
from dptse_env.sb3 import (
    SB3VecEnv,
    TrainedOn,
    load_policy,
    save_policy,
    shipped_policies,
)
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY
from tests.sb3.saved_files import ABOUT, SHORT, edit_card, edit_weights, make_policy


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
        extra["action_masks"] = ~env.unwrapped.process.pending.picked
    expected, _ = policy.predict(seen, deterministic=True, **extra)
    np.testing.assert_array_equal(loaded.predict(seen, deterministic=True)[0], expected)
    both, state = loaded.predict(batch, None, np.ones(2, bool), True)
    np.testing.assert_allclose(both, [expected, expected], atol=1e-6)
    assert state is None
    draws = []
    for acting in (policy, loaded):
        torch.manual_seed(5)
        draws.append(acting.predict(seen, **(extra if acting is policy else {}))[0])
    np.testing.assert_array_equal(*draws)
    env.step(expected)


def test_it_is_loaded_for_any_form_of_the_environment(stored):
    vector = gym.make_vec(
        SHORT, num_envs=3, action="slots", traffic_seeds="0:2", autoreset_mode="SameStep"
    )
    for env in (make_env(), vector, SB3VecEnv(vector)):
        assert load_policy(stored, env).card["training"]["seed"] == 3
    assert load_policy(str(stored), vector).predict(vector.reset(seed=0)[0])[0].shape == (3, 2)
    with pytest.raises(ValueError, match="env must be an environment of this package"):
        load_policy(stored, gym.make("CartPole-v1"))


def test_the_file_is_small_and_describes_the_policy(stored):
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
    assert card["trained_on"] == {
        "corridor": "short-highway", "n_mainline": 6, "lanes": 2, "segment_length": 0.1,
    }  # fmt: skip
    assert set(card["versions"]) == {"dptse-env", "stable-baselines3", "torch"}
    assert "ShortHighway-v0" in text
    assert "short-highway (6 mainline segments of 0.1 km, 2 lanes)" in text
    assert "| error | 0.123457 |" in text
    assert weights.keys() == policy.state_dict().keys()


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"bandwidth": 3}, r"bandwidth is 2 for the policy and 3 for the environment"),
        ({"action": "mask"}, r"action is 'slots' for the policy and 'mask' for the environment"),
        (
            {"incident": "none"},
            r"corridor is 'short-highway \(6 .*\), traffic (\w{8})' for the policy and "
            r"'short-highway \(6 .*\), traffic (?!\1)\w{8}' for the environment",
        ),
        (
            {"privacy": "capped"},
            r"\['mainline released_speed'\] are of .*\['mainline released_flow'\] of the env",
        ),
        ({"corridor": {"fixed_sensors": [7]}}, "observation is '.*fixed_speed_innovation:1"),
    ],
)
@pytest.mark.filterwarnings("ignore:privacy.preset")
def test_a_policy_that_does_not_fit_is_refused(stored, keywords, message):
    with pytest.raises(ValueError, match=message):
        load_policy(stored, make_env(**keywords))


def test_transfer_on_purpose(stored):
    env = make_env(bandwidth=3, incident="none", estimator="random_walk", epsilon=0.3)
    with pytest.raises(ValueError, match=r"corridor is .*to transfer it on purpose, allow corr"):
        load_policy(stored, env, allow=("bandwidth",))
    policy = load_policy(stored, env, allow=("bandwidth", "corridor"))
    action, _ = policy.predict(observe(env), deterministic=True)
    assert len(set(action.tolist())) == 3
    with pytest.raises(ValueError, match="allow must be of corridor, bandwidth, got 'action'"):
        load_policy(stored, env, allow=("action",))


def test_a_shared_network_moves_to_a_road_of_another_size(tmp_path):
    policy, config = make_policy(preset="paper-highway")
    path = tmp_path / "paper.zip"
    save_policy(path, policy, config, **ABOUT)
    env = make_env(bandwidth=5)
    both = r"'paper-highway \(15 mainline .* and 'short-highway \(6 mainline .*allow corridor$"
    with pytest.raises(ValueError, match=both):
        load_policy(path, env)
    loaded = load_policy(path, env, allow=("corridor",))
    assert loaded.trained_on == TrainedOn.from_corridor(PAPER_HIGHWAY)
    assert loaded.trained_on != TrainedOn.from_corridor(SHORT_HIGHWAY)
    # The same weights, made for the short road.
    direct, _ = make_policy(bandwidth=5)
    direct.load_state_dict(policy.state_dict())
    observation = observe(env)
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0],
        direct.predict(observation, deterministic=True)[0],
    )
    truncated = False
    while not truncated:
        action, _ = loaded.predict(observation)
        observation, _, _, truncated, info = env.step(action)
        assert info["n_dropped"] == 0


def test_a_perceptron_stays_on_its_road(tmp_path):
    policy, config = make_policy("scores", preset="paper-highway", bandwidth=2)
    save_policy(tmp_path / "paper.zip", policy, config, **ABOUT)
    env = make_env(action="scores")
    for allow in ((), ("corridor",), ("corridor", "bandwidth")):
        with pytest.raises(ValueError, match=r"is tied to the observation it") as refused:
            load_policy(tmp_path / "paper.zip", env, allow=allow)
        assert "on purpose" not in str(refused.value)  # there is no way to do it


def test_the_shipped_policy_moves_to_the_short_road():
    env = make_env(privacy={"preset": "capped", "cap": 64})
    with pytest.raises(ValueError, match="allow bandwidth and corridor"):
        load_policy("private-highway", env)
    policy = load_policy("private-highway", env, allow=("corridor", "bandwidth"))
    assert str(policy.trained_on) == "paper-highway (15 mainline segments of 0.1 km, 3 lanes)"
    observation, _ = env.reset(seed=0)
    for _ in range(30):
        action, _ = policy.predict(observation, deterministic=True)
        observation, _, _, _, info = env.step(action)
        assert info["queried"].sum() == 2
    with pytest.raises(ValueError, match=r"\['released_flow'\] are of .*\['released_speed'\]"):
        load_policy("private-highway", make_env(), allow=("corridor", "bandwidth"))


def test_cards_of_version_0_1_name_the_road_as_far_as_they_can(stored):
    def former(card):
        del card["trained_on"], card["fits"]["channels"]
        card["fits"]["corridor"] = "0" * 64

    edit_card(stored, former)
    loaded = load_policy(stored, make_env(), allow=("corridor",))
    assert loaded.trained_on == TrainedOn("short-highway", 6, None, None)
    assert str(loaded.trained_on) == "short-highway (6 mainline segments)"


def test_policies_of_version_0_1_query_segments_with_sensors(tmp_path):
    policy, config = make_policy("slots")
    path = tmp_path / "one.zip"
    save_policy(path, policy, config, **ABOUT)
    env = make_env()
    assert load_policy(path, env)._policy.skips_sensors
    edit_card(path, lambda card: _arguments(card).pop("skips_sensors"))
    assert not load_policy(path, env)._policy.skips_sensors


def test_files_that_are_not_there_or_damaged(stored, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no saved policy '.*absent.zip': neither a file"):
        load_policy(tmp_path / "absent.zip", make_env())
    content = stored.read_bytes()
    for damaged in (b"", b"text", content[: len(content) // 2]):
        stored.write_bytes(damaged)
        with pytest.raises(ValueError, match="is not a saved policy, or damaged"):
            load_policy(stored, make_env())


def refuses(path, action, edit, change, message):
    """Save a policy, edit its file, and have its one-line refusal name the file and the cause."""
    policy, config = make_policy(action)
    save_policy(path, policy, config, **ABOUT)
    edit(path, change)
    with pytest.raises(ValueError, match=message) as refused:
        load_policy(path, make_env(action=action))
    assert path.name in str(refused.value)
    assert "\n" not in str(refused.value)


WRONG_WEIGHTS = [
    ("slots", lambda w: w.update({"scorer.rule": print}), "more than .*tensors .*print"),
    ("slots", lambda w: w.clear(), r"must have 1\.\.256 tensors of weights, got 0"),
    ("slots", lambda w: w.pop("scorer.rule"), r"lacks weights 'scorer\.rule'"),
    ("slots", lambda w: w.update(extra=torch.zeros(2)), "unknown weights 'extra'"),
    ("slots", lambda w: w["scorer.rule"].fill_(torch.nan), "'scorer.rule' must be finite"),
    ("slots", lambda w: w.update({"scorer.rule": w["scorer.rule"].double()}), "DoubleStorage"),
    ("slots", lambda w: w.update({"scorer.rule": torch.zeros(4)}), r"shape \(3,\), got \(4,\)"),
    ("slots", lambda w: w.update({"scorer.trunk.whole.weight": torch.zeros(8, 8).t()}),
     "must be contiguous"),
    ("scores", lambda w: w.update({"action_net.weight": torch.zeros(1, 1).expand(6, 16)}),
     "must be contiguous"),
    ("mask", lambda w: w.update(log_std=torch.zeros(6)), "unknown weights 'log_std'"),
]  # fmt: skip


def test_weights_other_than_those_of_the_network_are_refused(tmp_path):
    for action, change, message in WRONG_WEIGHTS:
        refuses(tmp_path / "one.zip", action, edit_weights, change, message)


WRONG_CARDS = [
    ("slots", lambda c: c.pop("fits"), "field 'fits' of type dict"),
    ("slots", lambda c: c["fits"].update(format="dptse-policy-2"), "format is 'dptse-policy-2'"),
    ("slots", lambda c: c["fits"].update(bandwidth=True), r"'fits\.bandwidth' of type int"),
    ("slots", lambda c: c["fits"].update(action="x" * 3000), "more than 2000 characters"),
    ("slots", lambda c: c["fits"].update(channels=7), "'fits.channels' .* a list of names"),
    ("slots", lambda c: c["fits"]["channels"].append("colour"), r"\['colour'\] are of"),
    ("slots", lambda c: c["policy"].update({"class": "Oracle"}), "must be one of .*'Oracle'"),
    ("slots", lambda c: c["policy"].update({"class": "ActorCriticPolicy"}), "must be net_arch"),
    ("slots", lambda c: _arguments(c).update(width=12_000), r"\(12000, 23, 5\), got \(8, 23"),
    ("slots", lambda c: _arguments(c).update(width=10**30), r"width must be .* in 1\.\.100000"),
    ("slots", lambda c: _arguments(c).update(skips_sensors=1), "skips_sensors must be a bool"),
    ("slots", lambda c: _arguments(c).update(depth=3), "arguments must be rule, skips_"),
    ("slots", lambda c: _arguments(c).update(rule={"colour": 1}), "must be one of .*'colour'"),
    ("slots", lambda c: _arguments(c).update(rule={"age": 10**400}), "must be a number up to"),
    ("slots", lambda c: c.update(trained_on={"corridor": 3}), "does not describe the road"),
    ("mask", lambda c: _arguments(c).update(net_arch=[12_000]), r"\(12000, \d+\), got \(16, "),
    ("mask", lambda c: _arguments(c).update(net_arch=[0]), r"an integer in 1\.\.100000, got 0"),
    ("mask", lambda c: _arguments(c).update(net_arch={"qf": [1]}), "net_arch must have pi and"),
    ("mask", lambda c: c["policy"].update({"class": "MaskableActorCriticPolicy"}),
     "acts by action encoding 'sequential', got 'mask'"),
]  # fmt: skip


def test_damaged_cards_are_refused(tmp_path):
    for action, change, message in WRONG_CARDS:
        refuses(tmp_path / "one.zip", action, edit_card, change, message)


def _arguments(card):
    return card["policy"]["arguments"]


@pytest.mark.parametrize("net_arch", [[8, 4], {"pi": [8], "vf": [4, 4]}])
def test_perceptrons_of_all_shapes_are_loaded(tmp_path, net_arch):
    config = resolve("short-highway", {"action": (action := "scores")})
    interface = make_interface(config)
    spaces = interface.observations.space, interface.actions.space
    policy = ActorCriticPolicy(*spaces, lambda _: 1.0, net_arch=net_arch)
    save_policy(tmp_path / "one.zip", policy, config, **ABOUT)
    env = make_env(action=action)
    seen = observe(env)
    np.testing.assert_array_equal(
        load_policy(tmp_path / "one.zip", env).predict(seen, deterministic=True)[0],
        policy.predict(seen, deterministic=True)[0],
    )


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
    with torch.no_grad():
        policy.scorer.rule[0] = torch.nan
    with pytest.raises(ValueError, match=r"cannot be saved: .*'scorer.rule' must be finite"):
        save_policy(tmp_path / "one.zip", policy, config, **ABOUT)
    long = {**ABOUT, "figures": {"notes": "x" * 70_000}}
    with pytest.raises(ValueError, match=r"cannot be saved: .* more than 65536 bytes"):
        save_policy(tmp_path / "one.zip", make_policy()[0], config, **long)
    assert not list(tmp_path.iterdir())


def test_shipped_policies_are_loaded_by_name_whatever_files_there_are(stored, monkeypatch):
    stored.rename(stored.parent / "private-highway")
    monkeypatch.chdir(stored.parent)
    env = gym.make("dptse_env:dptse/PrivateHighway-v0", action="slots")
    assert load_policy("private-highway", env).card["env"] == "dptse_env:dptse/PrivateHighway-v0"
    with pytest.raises(FileNotFoundError, match=r"come with the package \(.*private-highway"):
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
