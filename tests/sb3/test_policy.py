import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch

from dptse_env.config import resolve
from dptse_env.parts import make_interface
from dptse_env.sb3 import PlackettLucePolicy, RoadChannels


def make_policy(preset="private-highway", *, skips_sensors=True, **keywords):
    config = resolve(preset, {"action": "slots", **keywords})
    interface = make_interface(config)
    torch.manual_seed(0)
    return PlackettLucePolicy(
        interface.observations.space,
        interface.actions.space,
        road=RoadChannels.from_config(config),
        skips_sensors=skips_sensors,
    )


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


def test_neighbours_and_the_whole_road_count():
    policy = make_policy()
    channels = policy.features(observations(policy, 1)).requires_grad_()
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


def test_weights_fit_other_roads_of_the_same_kinds():
    policy = make_policy("paper-highway")
    with pytest.warns(UserWarning, match="on another road"):
        other = make_policy("paper-highway", corridor={"n_mainline": 18}, bandwidth=7)
    other.load_state_dict(policy.state_dict())
    assert other.predict(observations(other).numpy())[0].max() > 14


def test_spaces_that_do_not_fit_are_refused():
    config = resolve("short-highway", {"action": "slots"})
    interface, road = make_interface(config), RoadChannels.from_config(config)
    seen, taken = interface.observations.space, interface.actions.space
    longer = spaces.Box(0, 1, (road.size + road.n_mainline,))
    for wrong in (longer, spaces.Box(0, 1, (3, 3)), taken):
        with pytest.raises(ValueError, match="observation_space must have shape"):
            PlackettLucePolicy(wrong, taken, road=road)
    misfits = [spaces.Discrete(6), spaces.MultiDiscrete([6, 5]), spaces.MultiDiscrete([6] * 7)]
    for wrong in misfits:
        with pytest.raises(ValueError, match=r"MultiDiscrete\(\[6\] \* B\).* of action='slots'"):
            PlackettLucePolicy(seen, wrong, road=road)
