"""Saved policies: they act as before, where they fit, and files that mislead are refused."""

import contextlib
import importlib
import warnings

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

import torch
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from dptse_env.config import resolve
from dptse_env.parts import make_interface
from dptse_env.policies import TRANSFERABLE, read_policy
from dptse_env.sb3 import (
    ActingPolicy,
    RoadChannels,
    SB3VecEnv,
    load_policy,
    save_policy,
    shipped_policies,
)
from dptse_env.sb3.saved import KINDS
from tests.helpers import ABOUT, SHORT, SumRelease, save_untrained, untrained
from tests.hostile import check_refusals, edited

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


CLASSES = {
    "RoadPolicy": ("slots", {"road": ..., "width": 8}),
    "ActorCriticPolicy": ("scores", {"net_arch": {"pi": [8], "vf": [4, 4]}}),
    "MaskableActorCriticPolicy": ("sequential", {"net_arch": [16]}),
    "RecurrentActorCriticPolicy": ("mask", {"lstm_hidden_size": 8, "activation_fn": nn.ReLU}),
    "DQNPolicy": ("sequential", {"net_arch": [8]}),
    "QRDQNPolicy": ("sequential", {"net_arch": [8], "n_quantiles": 5}),
}


def make(name):
    """An untrained policy of a class that can be saved, its configuration, and its encoding."""
    action, given = CLASSES[name]
    config = resolve("short-plain", {"action": action})
    interface = make_interface(config)
    if "road" in given:
        given = {**given, "road": RoadChannels.from_config(config)}
    kind = getattr(importlib.import_module(KINDS[name].module), name)
    torch.manual_seed(0)
    policy = kind(interface.observations.space, interface.actions.space, lambda _: 1.0, **given)
    return policy, config, action


@pytest.mark.parametrize("name", CLASSES)
def test_a_loaded_policy_acts_as_the_saved_one(path, name):
    policy, config, action = make(name)
    save_policy(path, policy, config, **ABOUT)
    env = make_env(action=action)
    seen = np.stack([observe(env)] * 2)
    seen[1] *= 0.5
    loaded = load_policy(path, env)
    extra = {}
    if name == "MaskableActorCriticPolicy":
        extra["action_masks"] = ~np.stack([env.unwrapped.process.pending.picked[0]] * 2)
    states, start = [None, None], np.ones(2, bool)
    for deterministic in (True, False):
        taken = []
        for k, (acting, more) in enumerate(((policy, extra), (loaded, {}))):
            torch.manual_seed(5)
            actions, states[k] = acting.predict(seen, states[k], start, deterministic, **more)
            taken.append(actions)
        np.testing.assert_array_equal(*taken)
        start = np.zeros(2, bool)
    assert (states[1] is None) == (name != "RecurrentActorCriticPolicy")
    one, _ = loaded.predict(seen[0], deterministic=True)
    np.testing.assert_allclose(one, policy.predict(
        seen[0], deterministic=True, **{key: masks[:1] for key, masks in extra.items()}
    )[0], atol=1e-6)  # fmt: skip
    env.step(one)


def test_normalisation_travels_in_the_file(path):
    env = gym.make_vec(SHORT, num_envs=3, action="scores", autoreset_mode="SameStep")
    scaled = VecNormalize(SB3VecEnv(env), clip_obs=2.0)
    observation = scaled.reset()
    for _ in range(20):
        observation, *_ = scaled.step(np.zeros((3, 6), np.float32))
    policy, config, _ = make("ActorCriticPolicy")
    save_policy(path, policy, config, normalisation=scaled, **ABOUT)
    seen = scaled.get_original_obs()
    assert np.abs(observation).max() == 2.0
    expected, _ = policy.predict(observation, deterministic=True)
    in_training = ActingPolicy(policy, make_interface(config), normalisation=scaled)
    for acting in (load_policy(path, env), in_training):
        np.testing.assert_array_equal(acting.predict(seen)[0], expected)
    assert (load_policy(path, env).predict(observation)[0] != expected).any()
    save_policy(path, policy, config, normalisation=VecNormalize(SB3VecEnv(env), norm_obs=False),
                **ABOUT)  # fmt: skip
    np.testing.assert_array_equal(load_policy(path, env).predict(observation)[0], expected)
    road, config, _ = make("RoadPolicy")
    with pytest.raises(ValueError, match="cannot be saved: RoadPolicy scales observations itself"):
        save_policy(path, road, config, normalisation=scaled, **ABOUT)


def test_the_card_says_whether_actions_are_drawn(path):
    policy, config, action = make("RoadPolicy")
    env = make_env(action=action)
    seen = np.stack([observe(env)] * 64)
    for deterministic in (True, False):
        save_policy(path, policy, config, deterministic=deterministic, **ABOUT)
        loaded = load_policy(path, env)
        assert loaded.deterministic == deterministic
        for told, same in ((None, deterministic), (True, True), (False, False)):
            actions, _ = loaded.predict(seen, deterministic=told)
            assert (actions == actions[0]).all() == same


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


def test_a_road_policy_acts_beside_loops_by_the_estimate_alone(stored):
    loops = make_env(loops={"positions": [0.0, 0.3]})
    with_loops = load_policy(stored, loops, allow=["corridor"])
    without = load_policy(stored, make_env())
    seen = loops.reset(seed=0)[0]
    plain = seen[: make_env().observation_space.shape[0]]
    assert len(plain) == len(seen) - 7
    np.testing.assert_array_equal(with_loops.predict(seen)[0], without.predict(plain)[0])


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"action": "mask"}, "action is 'slots' .* 'mask' .* with action='slots'$"),
        ({"bandwidth": 3}, "bandwidth is 2 .* 3 "),
        ({"query_every": 4}, "query_every is 1 .* 4 "),
        ({"incident": "none"}, r"corridor is .* traffic (\w{8})' .* traffic (?!\1)\w{8}' "),
        ({"privacy": "capped"}, r"channels is .*released_speed'\] .*released_flow'\]"),
        ({"corridor": {"fixed_sensors": [4, 7]}}, r"on \[5, 7\]\), .* on \[4, 7\]\)"),
        ({"loops": {"positions": [0.2], "ramps": [4]}}, "loops at 0.2 km, ramp 4 every 20 s"),
        ({"loops": {"positions": [0.2], "least_count": 5}}, r"every 20 s \(least count 5\)"),
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
        ((), r"'paper-highway .* and .short-highway .*allow bandwidth and"),
        (("bandwidth",), "corridor is .* on purpose, allow corridor$"),
        (("action",), "allow must be of .* got 'action'"),
    ):
        with pytest.raises(ValueError, match=message):
            load_policy(path, env, allow=allow)
    with warnings.catch_warnings(action="error"):  # of another epsilon
        loaded = load_policy(path, env, allow=TRANSFERABLE)
    # The same weights, made for the short road.
    direct, _ = untrained(bandwidth=3)
    direct.scorer.load_state_dict(policy.scorer.state_dict())
    observation = observe(env)
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0],
        direct.predict(observation, deterministic=True)[0],
    )


CAPPED = {"preset": "capped", "cap": 16}


@pytest.mark.parametrize(
    ("trained", "here", "told"),
    [
        ({"epsilon": 5.0}, {"epsilon": 1.0}, r"epsilon is 5\.0 .* 1\.0 "),
        ({"delta": 0.01}, {}, r"delta is 0\.01 .* 0\.05 "),
        ({"privacy": CAPPED}, {"privacy": "capped"}, r"privacy\.cap is 16 .* 64 "),
        ({}, {"privacy": "corrected"}, "preset is 'printed' .* 'corrected' "),
        ({}, {"privacy": {"noise": "secure"}}, None),
        ({"privacy": {"boundary_inputs": "true"}}, {}, None),
    ],
)
@pytest.mark.filterwarnings("ignore:privacy.preset")
def test_another_release_is_told_unless_it_is_allowed(path, trained, here, told):
    save_policy(path, *untrained(**trained), **ABOUT)
    env = make_env(**here)
    context = contextlib.nullcontext() if told is None else pytest.warns(UserWarning, match=told)
    with context as found:
        load_policy(path, env, allow=("bandwidth", "corridor"))
    assert found is None or len(found) == 1
    with warnings.catch_warnings(action="error"):
        load_policy(path, env, allow=("privacy",))


def test_a_perceptron_stays_on_its_road(path):
    save_untrained(path, "scores", preset="paper-highway", bandwidth=2)
    for allow in ((), ("corridor", "bandwidth")):
        with pytest.raises(ValueError, match=r"observation is 'density:19 ") as refused:
            load_policy(path, make_env(action="scores"), allow=allow)
        assert "on purpose" not in str(refused.value)  # there is no way to do it


@pytest.mark.parametrize("action", ["mask", "sequential"])
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
    with pytest.raises(ValueError, match=r"queries is \"query_spans \(1, 2\), bandwidth_unit"):
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


def arguments(**values):
    return lambda card, weights: card["policy"]["arguments"].update(values)


def clipped_at_zero(card, weights):
    size = weights["mlp_extractor.policy_net.0.weight"].shape[1]
    given = {"mean": np.zeros(size), "variance": np.ones(size), "clip": 0.0, "epsilon": 1e-8}
    weights.update({f"normalisation.{name}": np.array(each) for name, each in given.items()})


WRONG = {
    "mask": [
        (arguments(depth=3), "arguments must be layers, units, got"),
        (arguments(layers=[12_000] * 3), r"must be at most 1\d*, got 2\d{8}$"),
        (arguments(layers=[1] * 20_000), r"number must be .* got 20000"),
        (arguments(layers=[0]), r"an integer >= 1, got 0"),
        (arguments(layers={"pi": [1]}), "layers must be a list of widths"),
        (arguments(units="Linear"), "units must be one of Tanh, ReLU"),
        (lambda c, w: c.update(acts="both"), "acts must be one of deterministic, drawn"),
        (lambda c, w: w.update({"normalisation.clip": np.ones(())}), "lacks the arrays normal"),
        (clipped_at_zero, "clip and epsilon above 0"),
        (lambda c, w: c["policy"].update({"class": "MaskableActorCriticPolicy"}),
         "acts by action encoding 'sequential', got 'mask'"),
    ],
    "slots": [
        (lambda c, w: c["fits"].update(format="dptse-policy-1"), "format is 'dptse-policy-1'"),
        (lambda c, w: c["fits"].update(action="x" * 10**5), r"action is 'x+\.\.\.x+' "),
        (lambda c, w: c["fits"]["channels"].append("colour"), r"channels is \['colour'\] "),
        (lambda c, w: c["policy"].update({"class": "Oracle"}), "must be one of .*'Oracle'"),
        (lambda c, w: c["policy"].update({"class": "ActorCriticPolicy"}), "be layers, units, got"),
        (arguments(width=10**9), r"describe must be at most \d+, got 40{18}$"),
        (arguments(width=10**300), r"at most \d+, got an integer of 600 digits$"),
        (arguments(width=7), r"scorer\.\S+ must be float32 of shape"),
        (arguments(skips_sensors=1), "skips_sensors must be a bool"),
        (arguments(depth=3), "arguments must be reach, skips_sensors, width, got"),
        (lambda c, w: w.update(extra=np.zeros(2, "f4")), "it has the arrays extra"),
        (lambda c, w: w.pop("scorer.rule.weight"), "it lacks the arrays scorer.rule.weight"),
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


def test_what_cannot_be_saved(stored):
    before = stored.read_bytes()
    policy, config = untrained()
    with pytest.raises(ValueError, match=r"path must end in \.safetensors"):
        save_policy(stored.with_suffix(".pt"), policy, config, **ABOUT)
    with pytest.raises(ValueError, match="policy must be one of RoadPolicy"):
        save_policy(stored, torch.nn.Linear(1, 1), config, **ABOUT)
    with pytest.raises(ValueError, match=r"scorer\.\S+ must be float32 of shape"):
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
    with pytest.raises(ValueError, match=r"cannot be saved: policy has weights of .*extra.weight"):
        save_policy(stored, perceptron, masked, **ABOUT)
    assert stored.read_bytes() == before
    assert [each.name for each in stored.parent.iterdir()] == [stored.name]
