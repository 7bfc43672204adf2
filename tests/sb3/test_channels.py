import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch

from dptse_env.config import PRESETS
from dptse_env.parts import make_interface
from dptse_env.sb3 import RoadChannels
from dptse_env.sb3.torch_modules import RoadFeatures


def numbered(config):
    """An observation in which every number is its place, and where its blocks begin."""
    encoding = make_interface(config).observations
    starts = {name: place.start for name, place in encoding.slices.items()}
    return torch.arange(encoding.space.shape[0], dtype=torch.float32)[None], starts


def raw(road, name, observation):
    """The values of a channel before it is scaled; None where there are none."""
    (k,) = (k for k, channel in enumerate(road.channels) if channel.name == name)
    channel = road.channels[k]
    shown = RoadFeatures(road)(observation)[0, k].numpy() * channel.scale + channel.centre
    return [x if at is not None else None for x, at in zip(shown, channel.source, strict=True)]


@pytest.mark.parametrize("preset", PRESETS)
def test_mainline_blocks_stand_at_their_segments(preset):
    config = PRESETS[preset]
    road, n = RoadChannels.from_config(config), config.corridor.n_mainline
    observation, starts = numbered(config)
    released = (
        "released_flow" if preset.startswith(("private-highway", "long")) else "released_speed"
    )
    for name in ("density", "speed_log_std", "released_density", released, "age", "queried"):
        expected = starts[name] + np.arange(n)
        np.testing.assert_allclose(raw(road, f"mainline {name}", observation), expected, rtol=1e-5)
    assert RoadFeatures(road)(observation).shape == (1, road.n_channels, n)


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


def test_channels_of_real_observations_are_of_order_one():
    keywords = {"traffic_seeds": "0:2", "action": "slots"}
    env = gym.make("dptse_env:dptse/ShortHighway-v0", privacy="capped", **keywords)
    road = RoadFeatures(RoadChannels.from_config(env.unwrapped.config))
    env.reset(seed=0)
    env.action_space.seed(0)
    seen = [env.step(env.action_space.sample())[0] for _ in range(240)]
    shown = road(torch.tensor(np.stack(seen))).abs()
    assert shown.mean() < 1.5
    assert shown.amax(dim=(0, 2)).median() > 0.5
