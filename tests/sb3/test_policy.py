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
from dptse_env.sb3 import PlackettLucePolicy, RoadChannels, SB3VecEnv

SHORT = "dptse_env:dptse/ShortHighway-v0"


def make_policy(preset="private-highway", extra=0, **keywords):
    config = resolve(preset, {"action": "slots", **keywords})
    interface = make_interface(config)
    space = interface.observations.space
    if extra:
        space = spaces.Box(-np.inf, np.inf, (space.shape[0] + extra,), np.float32)
    torch.manual_seed(0)
    return PlackettLucePolicy(
        space, interface.actions.space, lambda _: 1e-3, road=RoadChannels.of(config)
    )


def observations(policy, k=64):
    torch.manual_seed(1)
    return torch.randn(k, policy.observation_space.shape[0])


@pytest.mark.parametrize("bandwidth", [1, 5, 15])
def test_actions_are_distinct_and_their_probabilities_agree(bandwidth):
    policy = make_policy(bandwidth=bandwidth)
    seen = observations(policy)
    actions, values, logs = policy(seen)
    assert actions.shape == (64, bandwidth)
    assert (actions.sort(dim=1).values.diff(dim=1) > 0).all()
    # A rollout buffer keeps actions as floats.
    again, log_prob, entropy = policy.evaluate_actions(seen, actions.float())
    torch.testing.assert_close(again, values)
    torch.testing.assert_close(log_prob, logs)
    torch.testing.assert_close(policy.predict_values(seen), values)
    torch.testing.assert_close(policy.get_distribution(seen).log_prob(actions), logs)
    assert (entropy >= 0).all()
    assert values.shape == (64, 1)


def test_deterministic_actions_are_the_highest_scores():
    policy = make_policy()
    seen = observations(policy)
    scores = policy.scorer(policy.channels(seen))
    best = scores.argsort(dim=1, descending=True)[:, :5]
    assert torch.equal(policy(seen, deterministic=True)[0], best)
    actions, state = policy.predict(seen.numpy(), deterministic=True)
    np.testing.assert_array_equal(actions, best.numpy())
    assert state is None
    np.testing.assert_array_equal(policy.predict(seen[0].numpy(), deterministic=True)[0], best[0])
    drawn = [policy.predict(seen.numpy())[0] for _ in range(2)]
    assert (drawn[0] != drawn[1]).any()


def test_untrained_it_stands_near_its_rule():
    policy = make_policy()
    channels = policy.channels(observations(policy))
    rule = sum(
        weight * channels[:, policy.road.index(name)] for name, weight in policy.rule.items()
    )
    rest = policy.scorer(channels) - rule
    assert 0 < rest.std() < 0.1 * rule.std()


def test_neighbours_and_the_whole_road_count():
    policy = make_policy()
    channels = policy.channels(observations(policy, 1)).requires_grad_()
    (gradient,) = torch.autograd.grad(policy.scorer(channels)[0, 7], channels)
    seen = gradient[0].abs().sum(dim=0)
    near = seen[3:12]
    assert (near > 0).all()
    # Two convolutions of width 5 reach four segments; what is further counts by the mean alone.
    far = torch.cat([seen[:3], seen[12:]])
    assert (far > 0).all()
    assert far.max() < near.max()


def test_segments_share_one_scorer():
    """Shifted along a road without ramps, away from its ends, scores shift with the traffic."""
    policy = make_policy()
    channels = torch.zeros(1, policy.road.n_channels, 15)
    channels[0, :3, 7] = 1.0
    scores = policy.scorer(channels)
    shifted = policy.scorer(channels.roll(1, dims=2))
    torch.testing.assert_close(shifted[:, 4:12], scores[:, 3:11])


def test_the_value_has_a_network_of_its_own():
    policy = make_policy()
    policy.predict_values(observations(policy)).sum().backward()
    assert all(parameter.grad is None for parameter in policy.scorer.parameters())
    assert all(parameter.grad is not None for parameter in policy.critic.parameters())


def test_what_is_for_the_critic_never_reaches_the_scores():
    policy = make_policy(extra=30)
    seen = observations(policy).requires_grad_()
    scores = policy.get_distribution(seen).scores
    (gradient,) = torch.autograd.grad(scores.sum(), seen, retain_graph=True)
    assert (gradient[:, policy.road.size :] == 0).all()
    (gradient,) = torch.autograd.grad(policy.predict_values(seen).sum(), seen)
    assert (gradient[:, policy.road.size :] != 0).any()
    plain_space = make_policy().observation_space
    plain = policy.without_extra(plain_space)
    short = seen.detach()[:, : policy.road.size]
    torch.testing.assert_close(plain.get_distribution(short).scores, scores)


def test_the_critic_learns_at_a_rate_of_its_own():
    policy = make_policy()
    for parameter in policy.parameters():
        parameter.grad = torch.ones_like(parameter)
    before = [policy.scorer.rule.clone(), policy.critic.share[2].bias.clone()]
    policy.optimizer.step()
    moved = [
        (now - then).abs().max().item()
        for now, then in zip([policy.scorer.rule, policy.critic.share[2].bias], before, strict=True)
    ]
    # The first step of Adam is the rate itself.
    assert moved == pytest.approx([1e-3, 3e-2], rel=1e-3)
    assert [group["lr"] for group in policy.optimizer.param_groups] == [1e-3, 1e-3]


@pytest.mark.parametrize("preset", PRESETS)
def test_its_size_is_bounded_and_does_not_depend_on_the_road(preset):
    policy = make_policy(preset)
    n_parameters = sum(parameter.numel() for parameter in policy.parameters())
    assert 20_000 < n_parameters < 60_000


def test_weights_fit_other_roads_of_the_same_kinds():
    policy = make_policy("paper-highway")
    other = make_policy("paper-highway", corridor={"n_mainline": 18}, bandwidth=7)
    other.load_state_dict(policy.state_dict())
    assert other.predict(observations(other).numpy())[0].max() > 14


def test_ppo_learns_with_it_and_it_can_be_saved(tmp_path):
    keywords = {"traffic_seeds": "0:2", "horizon": 20, "random_start": True, "action": "slots"}
    env = SB3VecEnv(gym.make_vec(SHORT, num_envs=4, autoreset_mode="SameStep", **keywords))
    road = RoadChannels.of(env.env.config)
    model = PPO(
        PlackettLucePolicy, env, n_steps=20, batch_size=40, policy_kwargs={"road": road}, seed=0
    )
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(160)
    after = model.policy.state_dict()
    assert all((after[name] != before[name]).any() for name in after)
    assert all(torch.isfinite(value).all() for value in after.values())
    model.policy.save(str(tmp_path / "policy.zip"))
    loaded = PlackettLucePolicy.load(str(tmp_path / "policy.zip"))
    seen = env.reset()
    np.testing.assert_array_equal(
        loaded.predict(seen, deterministic=True)[0], model.predict(seen, deterministic=True)[0]
    )


def test_spaces_that_do_not_fit_are_refused():
    config = resolve("short-highway", {"action": "slots"})
    interface, road = make_interface(config), RoadChannels.of(config)
    seen, taken = interface.observations.space, interface.actions.space
    for wrong in (spaces.Box(0, 1, (road.size + 1,)), spaces.Box(0, 1, (3, 3)), taken):
        with pytest.raises(ValueError, match="observation_space must have shape"):
            PlackettLucePolicy(wrong, taken, lambda _: 1.0, road=road)
    others = [spaces.Discrete(6), spaces.MultiDiscrete([6, 5]), spaces.MultiDiscrete([6] * 7)]
    for wrong in others:
        with pytest.raises(ValueError, match=r"MultiDiscrete\(\[6\] \* B\).* of action='slots'"):
            PlackettLucePolicy(seen, wrong, lambda _: 1.0, road=road)
