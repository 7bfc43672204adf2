"""Saved policies: they act as before, where they fit, and files that mislead are refused."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dptse_env.policies import read_policy
from dptse_env.sb3 import SB3VecEnv, load_policy, save_policy, shipped_policies
from tests.helpers import ABOUT, SHORT, SumRelease, save_untrained, untrained
from tests.hostile import check_hostile, check_refusals, edited

SPANS = {"privacy": SumRelease, "query_spans": (1, 2), "bandwidth": 3}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "one.safetensors"


@pytest.fixture
def stored(path):
    return save_untrained(path, seed=3)


def make_env(**keywords):
    return gym.make(SHORT, **{"action": "slots", "traffic_seeds": "0:2", **keywords})


def observe(env):
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(30):
        observation = env.step(env.action_space.sample())[0]
    return observation


@pytest.mark.parametrize(
    ("action", "net_arch"),
    [
        ("slots", None),
        ("scores", [8, 4]),
        ("mask", {"pi": [8], "vf": [4, 4]}),
        ("sequential", [16]),
    ],
)
def test_a_loaded_policy_acts_as_the_saved_one(path, action, net_arch):
    policy, config = untrained(action, net_arch=net_arch)
    save_policy(path, policy, config, **ABOUT)
    env = make_env(action=action)
    loaded = load_policy(path, env)
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
    if action == "slots":
        scores = (each.scores(torch.tensor(batch)) for each in (loaded._policy, policy))
        torch.testing.assert_close(*scores, rtol=0, atol=0)
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
    before = torch.get_rng_state()
    for env in (make_env(), vector, SB3VecEnv(vector)):
        assert load_policy(stored, env).card["training"]["seed"] == 3
    assert torch.equal(torch.get_rng_state(), before)
    assert load_policy(str(stored), vector).predict(vector.reset(seed=0)[0])[0].shape == (3, 2)
    with pytest.raises(ValueError, match="env must be an environment of this package"):
        load_policy(stored, gym.make("CartPole-v1"))


def test_the_card_describes_the_policy(stored):
    policy, config = untrained()
    file = read_policy(stored)
    assert file.card["fits"]["corridor"] == config.corridor.digest
    assert file.card["fits"]["bandwidth"] == 2
    assert file.card["keywords"] == {"estimator": "ekf"}
    assert file.card["trained_on"] == (
        "short-highway (6 mainline segments of 0.1 km, 2 lanes, fixed sensors on [5, 7])"
    )
    assert set(file.card["versions"]) == {"dptse-env", "stable-baselines3", "torch"}
    assert file.card["figures"] == ABOUT["figures"]
    assert file.weights.keys() == {f"scorer.{key}" for key in policy.scorer.state_dict()}
    assert file.identity == file.card["sha256"]


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
            r"channels is \['mainline released_speed'\] for .*\['mainline released_flow'\]",
        ),
        ({"corridor": {"fixed_sensors": [7]}}, r"sensors on \[5, 7\]\), .* sensors on \[7\]\)"),
    ],
)
@pytest.mark.filterwarnings("ignore:privacy.preset")
def test_a_policy_that_does_not_fit_is_refused(stored, keywords, message):
    with pytest.raises(ValueError, match=message):
        load_policy(stored, make_env(**keywords))


def test_a_shared_network_moves_on_purpose_to_another_road_and_bandwidth(path):
    policy, config = untrained(preset="paper-highway")
    save_policy(path, policy, config, **ABOUT)
    env = make_env(bandwidth=3, incident="none", estimator="random_walk", epsilon=0.3)
    for allow, message in (
        (
            (),
            r"'paper-highway \(15 mainline .* and .short-highway .*allow bandwidth and",
        ),
        (("bandwidth",), r"corridor is .*to transfer it on purpose, allow corridor$"),
        (("action",), "allow must be of corridor, bandwidth, got 'action'"),
    ):
        with pytest.raises(ValueError, match=message):
            load_policy(path, env, allow=allow)
    loaded = load_policy(path, env, allow=("bandwidth", "corridor"))
    # The same weights, made for the short road.
    direct, _ = untrained(bandwidth=3)
    direct.scorer.load_state_dict(policy.scorer.state_dict())
    observation = observe(env)
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0],
        direct.predict(observation, deterministic=True)[0],
    )


def test_a_perceptron_stays_on_its_road(path):
    save_untrained(path, "scores", preset="paper-highway", bandwidth=2)
    for allow in ((), ("corridor", "bandwidth")):
        with pytest.raises(ValueError, match=r"observation is 'density:19 ") as refused:
            load_policy(path, make_env(action="scores"), allow=allow)
        assert "on purpose" not in str(refused.value)  # there is no way to do it


@pytest.mark.parametrize("action", ["mask", "scores", "sequential"])
def test_a_perceptron_queries_several_segments_at_once(path, action):
    save_untrained(path, action, **SPANS)
    env = make_env(action=action, **SPANS)
    policy = load_policy(path, env)
    observation, _ = env.reset(seed=0)
    for _ in range(12):
        observation, *_, info = env.step(policy.predict(observation)[0])
        assert info["queried"] @ env.unwrapped.config.queries.cost <= 3
        assert action != "sequential" or info["n_dropped"] == 0
    other = make_env(action=action, **SPANS, bandwidth_unit="sums")
    with pytest.raises(ValueError, match=r"queries is \"query_spans \(1, 2\) and price_levels"):
        load_policy(path, other, allow=("corridor", "bandwidth"))


@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_policy_acts_where_it_was_trained(name):
    card = read_policy(name).card
    env = gym.make_vec(
        card["env"], num_envs=2, action=card["fits"]["action"], traffic_seeds="0:1",
        **card["keywords"],
    )  # fmt: skip
    policy = load_policy(name, env)
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        actions, _ = policy.predict(observation, deterministic=True)
        observation, *_, infos = env.step(actions)
        assert (infos["queried"].sum(axis=1) == env.config.bandwidth).all()
        assert not infos["n_dropped"].any()


@pytest.mark.parametrize("action", ["slots", "mask"])
def test_damaged_files_are_refused(tmp_path, action):
    env = make_env(action=action)
    good = save_untrained(tmp_path / "good.safetensors", action)
    check_hostile(lambda path: load_policy(path, env), good, tmp_path / "bad.safetensors")


def arguments(**values):
    return lambda card, weights: card["policy"]["arguments"].update(values)


WRONG = {
    "slots": [
        (lambda c, w: c["fits"].update(format="dptse-policy-2"), "format is 'dptse-policy-2'"),
        (lambda c, w: c["fits"].update(action="x" * 10**5), "action is 'xxx"),
        (lambda c, w: c["fits"]["channels"].append("colour"), r"channels is \['colour'\] for the"),
        (lambda c, w: c["fits"].update(channels=[{}] * 9), r"channels is \['\{\}'\] for the"),
        (lambda c, w: c["policy"].update({"class": "Oracle"}), "must be one of .*'Oracle'"),
        (lambda c, w: c["policy"].update({"class": "ActorCriticPolicy"}), "must be net_arch"),
        (arguments(width=10**9), r"describe 4e\+18 weights, it has \d{3}"),
        (lambda c, w: (arguments(width=2000)(c, w), w.update(extra=np.zeros(2**22 - 2**14, "f4"))),
         r"describe 1\.6e\+07 weights, it has 4\d{6}"),
        (arguments(width=7), "size mismatch for scorer.trunk.near.weight"),
        (arguments(skips_sensors=1), "skips_sensors must be a bool"),
        (arguments(depth=3), "arguments must be reach, skips_sensors, width, got"),
        (lambda c, w: w.update(extra=np.zeros(2, "f4")), r'Unexpected key\(s\) .*"extra"'),
        (lambda c, w: w.pop("scorer.rule.weight"), r'Missing key\(s\) .*"scorer.rule.weight"'),
    ],
    "mask": [
        (arguments(net_arch=[12_000] * 3), r"describe 2\.\d+e\+08 weights, it has 2"),
        (arguments(net_arch=[1] * 20_000), r"layers must be an integer in 0\.\.64, got 20000"),
        (arguments(net_arch=[0]), r"an integer >= 1, got 0"),
        (arguments(net_arch={"qf": [1]}), "net_arch must be a list of widths, or one each for pi"),
        (arguments(net_arch=[[8]]), r"net_arch\[0\] must be an integer"),
        (lambda c, w: c["policy"].update({"class": "MaskableActorCriticPolicy"}),
         "acts by action encoding 'sequential', got 'mask'"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("action", WRONG)
def test_cards_and_weights_that_do_not_agree_are_refused(tmp_path, action):
    env, good = make_env(action=action), save_untrained(tmp_path / "good.safetensors", action)
    load_policy(good, env)
    for k, (change, message) in enumerate(WRONG[action]):
        path = tmp_path / f"bad-{k}.safetensors"
        check_refusals(lambda path: load_policy(path, env), path, [(k, edited(good, change))])
        with pytest.raises(ValueError, match=message):
            load_policy(path, env)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(-9, 9) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=6,
)


@pytest.fixture(scope="module")
def acting(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved")
    return {
        action: (save_untrained(folder / f"{action}.safetensors", action), make_env(action=action))
        for action in ("slots", "scores", "sequential")
    }


@given(data=st.data())
@settings(max_examples=60)
def test_edited_cards_are_refused_or_act(acting, data):
    good, env = acting[data.draw(st.sampled_from(sorted(acting)))]

    def change(card, weights):
        node = card
        for key in data.draw(st.sampled_from([["policy", "arguments"], ["fits"], ["policy"], []])):
            node = node[key]
        node[data.draw(st.sampled_from(sorted(node)))] = data.draw(json_values)

    path = good.with_name("edited.safetensors")
    path.write_bytes(edited(good, change))
    try:
        policy = load_policy(path, env, allow=("corridor", "bandwidth"))
    except ValueError as problem:
        refusal = str(problem)
    else:
        refusal = "edited.safetensors"
        observation, _ = env.reset(seed=0)
        env.step(policy.predict(observation)[0])
    assert "edited.safetensors" in refusal
    assert len(refusal.splitlines()) == 1


def test_what_cannot_be_saved(stored):
    before = stored.read_bytes()
    policy, config = untrained()
    with pytest.raises(ValueError, match=r"path must end in \.safetensors"):
        save_policy(stored.with_suffix(".pt"), policy, config, **ABOUT)
    with pytest.raises(ValueError, match="policy must be one of RoadPolicy"):
        save_policy(stored, torch.nn.Linear(1, 1), config, **ABOUT)
    with pytest.raises(ValueError, match="weights must be of float32 alone"):
        save_policy(stored, untrained()[0].double(), config, **ABOUT)
    long = {**ABOUT, "figures": {"notes": "x" * 2**21}}
    with pytest.raises(ValueError, match=r"cannot be written: its header must have at most"):
        save_policy(stored, policy, config, **long)
    with torch.no_grad():
        policy.scorer.rule.weight[0] = torch.nan
    with pytest.raises(ValueError, match=r"cannot be written: scorer.rule.weight must be finite"):
        save_policy(stored, policy, config, **ABOUT)
    perceptron, masked = untrained("mask")
    perceptron.extra = torch.nn.Linear(1, 1)
    with pytest.raises(ValueError, match=r"cannot be saved: .*Unexpected key\(s\).*extra.weight"):
        save_policy(stored, perceptron, masked, **ABOUT)
    assert stored.read_bytes() == before
    assert [each.name for each in stored.parent.iterdir()] == [stored.name]
