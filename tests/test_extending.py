"""The examples of docs/extending.md run as they stand."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
SECTION = re.compile(r"^## ([^\n]*)\n(?:(?!^## ).)*?```python\n(.*?)```", re.DOTALL | re.MULTILINE)
EXAMPLES = dict(SECTION.findall(PAGE.read_text(encoding="utf-8")))


def test_every_example_runs():
    assert EXAMPLES
    for name in EXAMPLES:
        check(name)


def check(name):
    space = {"__name__": "examples"}
    exec(compile(EXAMPLES[name], f"{PAGE.name}, {name}", "exec"), space)
    if "env" not in space:
        return
    env, policy = space["env"], space.get("schedule")
    observation, info = env.reset(seed=0)
    state = None
    for _ in range(20):
        if policy is None:
            action = env.action_space.sample()
        else:
            action, state = policy.predict(observation, state)
        observation, reward, *_, info = env.step(action)
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        assert np.isfinite(info["rmse_density"])
    assert isinstance(env, gym.Env)
