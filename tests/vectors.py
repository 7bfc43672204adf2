"""Batches of short episodes, and how they are compared."""

import gymnasium as gym
import numpy as np
import pytest

SHORT = "dptse_env:dptse/ShortHighway-v0"
COUNTED = {"preset": "capped", "cap": 5, "boundary_inputs": "private"}
EPISODES = {"traffic_seeds": "0:3", "horizon": 6, "random_start": True}


def short(num_envs=3, **keywords):
    return gym.make_vec(SHORT, num_envs=num_envs, **{**EPISODES, **keywords})


def assert_same(first, second, tolerance=1e-10):
    """Compare everything that came back, dtypes and the keys of dicts too."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key], tolerance)
    elif isinstance(first, tuple | list):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other, tolerance)
    elif isinstance(first, np.ndarray):
        assert (first.dtype, first.shape) == (second.dtype, second.shape)
        if first.dtype == object:
            assert_same(first.tolist(), second.tolist(), tolerance)
        elif first.dtype.kind == "f":
            np.testing.assert_allclose(first, second, rtol=0, atol=tolerance)
        else:
            np.testing.assert_array_equal(first, second)
    else:
        assert type(first) is type(second)
        assert first == (pytest.approx(second, abs=tolerance) if type(first) is float else second)


def briefly(env_id):
    """Keywords with which an id's records take a second, whatever the length of its road."""
    is_short = env_id.endswith("ShortHighway-v0")
    return {} if is_short else {"corridor": {"duration": 60, "incident": None}}


def lock_step(keywords, n_steps, env_id=SHORT, **more):
    """Hold n scalar environments of seeds s + i, wherever they are, against the batch."""
    keywords = {**EPISODES, **keywords}
    batch = gym.make_vec(env_id, num_envs=3, **more, **keywords)
    vectorise = {"autoreset_mode": more["autoreset_mode"]} if more else None
    singles = gym.make_vec(
        env_id, num_envs=3, vectorization_mode="sync", vector_kwargs=vectorise, **keywords
    )
    assert batch.action_space == singles.action_space
    assert batch.observation_space == singles.observation_space
    assert_same(batch.reset(seed=7), singles.reset(seed=7))
    batch.action_space.seed(1)
    for _ in range(n_steps):
        actions = batch.action_space.sample()
        came_back = batch.step(actions)
        assert came_back[0] in batch.observation_space
        assert_same(came_back, singles.step(actions))
    assert_same(batch.np_random_seed, singles.np_random_seed)
    draws = [[g.integers(2**63) for g in env.np_random] for env in (batch, singles)]
    assert draws[0] == draws[1]


def staggered(**keywords):
    """Return an environment whose episodes 0 and 2 are two steps behind episode 1."""
    env = short(**keywords)
    actions = np.zeros((3, 6), dtype=np.int8)
    env.reset(seed=3)
    env.step(actions)
    env.step(actions)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    return env, actions
