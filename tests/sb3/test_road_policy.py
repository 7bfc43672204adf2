"""Channels along the road, and `RoadPolicy`, which scores segments by them."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO

from dptse_env.config import PRESETS, resolve
from dptse_env.parts import make_interface
from dptse_env.sb3 import RoadChannels, RoadPolicy, SB3VecEnv
from dptse_env.sb3.road_policy import Neighbourhoods, RoadFeatures
from tests.helpers import SHORT, PricedRelease, SumRelease

# The observation as channels along the road.


def numbered(config):
    """An observation in which every number is its place, and where its blocks begin."""
    encoding = make_interface(config).observations
    starts = {name: place.start for name, place in encoding.slices.items()}
    return torch.arange(encoding.space.shape[0], dtype=torch.float32)[None], starts


def raw(road, name, observation):
    """The values of a channel before it is scaled; None where there are none."""
    (k,) = (k for k, channel in enumerate(road.channels) if channel.name == name)
    channel = road.channels[k]
    shown = RoadFeatures(road, 1)(observation)[:, k, 0].numpy() * channel.scale + channel.centre
    return [x if at is not None else None for x, at in zip(shown, channel.source, strict=True)]


def test_mainline_blocks_stand_at_their_segments():
    for preset, flow in (("paper-highway", False), ("long-highway", True)):
        config = PRESETS[preset]
        road, n = RoadChannels.from_config(config), config.corridor.geometry.n_mainline
        observation, starts = numbered(config)
        released = "released_flow" if flow else "released_speed"
        for name in ("density", "speed_log_std", "released_density", released, "age", "queried"):
            found = raw(road, f"mainline {name}", observation)
            np.testing.assert_allclose(found, starts[name] + np.arange(n), rtol=1e-5)
        features = RoadFeatures(road, 2)
        assert features(observation).shape == (n, features.n_inputs, 1)


def test_ramps_stand_where_they_join_and_fixed_sensors_with_them():
    config = PRESETS["paper-highway"]  # on-ramps at faces 3 and 9, off-ramps at 6 and 12
    road = RoadChannels.from_config(config)
    observation, starts = numbered(config)
    on, off = (raw(road, f"{kind}-ramp density", observation) for kind in ("on", "off"))
    assert {i: round(x) - starts["density"] for i, x in enumerate(on) if x is not None} == {
        3: 15, 9: 16,
    }  # fmt: skip
    assert {i: round(x) - starts["density"] for i, x in enumerate(off) if x is not None} == {
        5: 17, 11: 18,
    }  # fmt: skip
    innovation = raw(road, "off-ramp fixed_density_innovation", observation)
    first = starts["fixed_density_innovation"]
    assert {i: round(x) - first for i, x in enumerate(innovation) if x is not None} == {5: 1, 11: 2}
    assert [np.flatnonzero(mark).tolist() for mark in road.marks] == [[3, 9], [5, 11], [14]]


def test_prices_and_the_spent_share_are_channels_where_they_are_observed():
    named = [RoadChannels.from_config(resolve("short-plain", {"privacy": privacy})).channels
             for privacy in (SumRelease, PricedRelease)]  # fmt: skip
    without, priced = ({channel.name for channel in channels} for channels in named)
    assert priced - without == {"mainline last_price", "mainline spent_share"}


# The policy.


def make_policy(preset="private-highway", *, skips_sensors=True, **keywords):
    config = resolve(preset, {"action": "slots", "bandwidth": 5, **keywords})
    torch.manual_seed(0)
    return RoadPolicy.from_config(config, skips_sensors=skips_sensors)


def observations(policy, k=64):
    torch.manual_seed(1)
    return torch.randn(k, policy.observation_space.shape[0])


@pytest.mark.parametrize("bandwidth", [1, 5, 15])
def test_actions_are_distinct_and_follow_the_distribution(bandwidth):
    policy = make_policy(bandwidth=bandwidth)
    seen = observations(policy)
    torch.manual_seed(2)
    actions, _ = policy.predict(seen.numpy())
    assert actions.shape == (64, bandwidth)
    assert (np.diff(np.sort(actions, axis=1), axis=1) > 0).all()
    torch.manual_seed(2)
    distribution = policy.get_distribution(seen)
    np.testing.assert_array_equal(distribution.sample().numpy(), actions)
    assert torch.isfinite(distribution.log_prob(torch.from_numpy(actions))).all()


def test_deterministic_actions_are_the_highest_scores():
    policy = make_policy()
    seen = observations(policy)
    scores = policy.scores(seen).detach()
    scores[:, 14] = -torch.inf  # the last segment has a fixed sensor
    best = scores.argsort(dim=1, descending=True)[:, :5]
    actions, state = policy.predict(seen.numpy(), deterministic=True)
    np.testing.assert_array_equal(actions, best.numpy())
    assert state is None
    np.testing.assert_array_equal(policy.predict(seen[0].numpy(), deterministic=True)[0], best[0])
    drawn = [policy.predict(seen.numpy())[0] for _ in range(2)]
    assert (drawn[0] != drawn[1]).any()


def test_a_segment_with_a_fixed_sensor_is_queried_when_there_is_no_other():
    seen = observations(make_policy())
    for deterministic in (True, False):
        some, _ = make_policy(bandwidth=14).predict(seen.numpy(), deterministic=deterministic)
        assert not (some == 14).any()
        every, _ = make_policy(bandwidth=15).predict(seen.numpy(), deterministic=deterministic)
        assert (every[:, -1] == 14).all()


def test_neighbours_come_with_a_segment_and_its_place():
    road = make_policy().road
    observation = torch.rand(1, road.size)
    inputs = RoadFeatures(road, 2)(observation)[..., 0]
    own = inputs[:, : (inputs.shape[1] - 3) // 5]
    upstream, downstream = (
        inputs[:, own.shape[1] : 2 * own.shape[1]],
        inputs[:, -3 - own.shape[1] : -3],
    )
    torch.testing.assert_close(upstream[2:], own[:-2])
    torch.testing.assert_close(downstream[:-2], own[2:])
    assert not upstream[:2].any()
    assert not downstream[-2:].any()
    place = torch.linspace(-1, 1, 15)
    torch.testing.assert_close(inputs[:, -3:], torch.stack([place, place**2, 1 + 0 * place], 1))


@pytest.mark.parametrize(("n", "reach"), [(5, 1), (5, 2), (3, 4)])
def test_neighbourhoods_are_those_of_a_padded_road_and_so_is_their_gradient(n, reach):
    torch.manual_seed(0)
    features = torch.randn(n, 3, 4, requires_grad=True)
    padded = torch.nn.functional.pad(features, (0, 0, 0, 0, reach, reach))
    expected = torch.cat([padded[i : i + n] for i in range(2 * reach + 1)], dim=1)
    around = Neighbourhoods.apply(features, reach)
    torch.testing.assert_close(around, expected, rtol=0, atol=0)
    weights = torch.randn_like(expected)
    gradients = [
        torch.autograd.grad((each * weights).sum(), features) for each in (around, expected)
    ]
    torch.testing.assert_close(*gradients)


def test_policies_of_two_environments_share_their_weights():
    policy = make_policy("short-highway")
    config = resolve("short-plain", {"action": "slots", "bandwidth": 4})
    twin = policy.sharing(config)
    with torch.no_grad():
        policy.scorer.rule.weight.add_(1.0)
    seen = observations(policy)
    torch.testing.assert_close(twin.scores(seen), policy.scores(seen), rtol=0, atol=0)
    assert twin.bandwidth == 4
    with pytest.raises(ValueError, match=r"one lacks \['mainline released_speed'\]"):
        policy.sharing(resolve("short-plain", {"action": "slots", "privacy": "capped"}))


def test_ppo_trains_saves_and_loads_it(tmp_path):
    keywords = {"action": "slots", "bandwidth": 3, "autoreset_mode": "SameStep"}
    env = SB3VecEnv(gym.make_vec(SHORT, num_envs=4, **keywords))
    keywords = {"n_steps": 8, "batch_size": 16, "n_epochs": 2, "seed": 0}
    model = PPO(RoadPolicy, env, policy_kwargs=RoadPolicy.kwargs(env), **keywords)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    model.learn(64)
    after = model.policy.state_dict()
    assert [key for key in after if torch.equal(after[key], before[key])] == []
    model.save(tmp_path / "model.zip")
    model.policy.save(tmp_path / "policy.pt")
    seen = observations(model.policy).numpy()
    expected, _ = model.predict(seen, deterministic=True)
    assert expected.shape == (64, 3)
    for loaded in (PPO.load(tmp_path / "model.zip"), RoadPolicy.load(tmp_path / "policy.pt")):
        np.testing.assert_array_equal(loaded.predict(seen, deterministic=True)[0], expected)


def test_an_update_of_ppo_sees_what_a_rollout_did():
    policy = make_policy(bandwidth=3)
    seen = observations(policy)
    actions, values, logs = policy(seen)
    again = policy.evaluate_actions(seen, actions.float())  # as a rollout buffer keeps them
    torch.testing.assert_close(again[0], values)
    torch.testing.assert_close(again[1], logs)
    torch.testing.assert_close(policy.predict_values(seen), values)
    assert values.shape == (64, 1)


def test_spaces_that_do_not_fit_are_refused():
    config = resolve("short-plain", {"action": "slots"})
    interface, road = make_interface(config), RoadChannels.from_config(config)
    seen, taken = interface.observations.space, interface.actions.space
    longer = spaces.Box(0, 1, (road.size + road.n_mainline,))
    for wrong in (longer, spaces.Box(0, 1, (3, 3)), taken):
        with pytest.raises(ValueError, match="observation_space must have shape"):
            RoadPolicy(wrong, taken, road=road)
    misfits = [spaces.Discrete(6), spaces.MultiDiscrete([6, 5]), spaces.MultiDiscrete([6] * 7)]
    for wrong in misfits:
        with pytest.raises(ValueError, match=r"MultiDiscrete\(\[6\] \* B\).* of action='slots'"):
            RoadPolicy(seen, wrong, road=road)
