"""The examples of docs/extending.md run as they stand."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
SECTION = re.compile(r"^## ([^\n]*)\n(?:(?!^## ).)*?```python\n(.*?)```", re.DOTALL | re.MULTILINE)
EXAMPLES = dict(SECTION.findall(PAGE.read_text(encoding="utf-8")))
POINTS = [
    "Estimator", "Release model", "Reward", "Observation block", "Action encoding", "Corridor",
    "Schedule", "Names", "Parts of a process",
]  # fmt: skip


def test_every_extension_point_has_an_example_of_25_lines_at_most():
    assert list(EXAMPLES) == POINTS
    for name, code in EXAMPLES.items():
        assert len([line for line in code.splitlines() if line.strip()]) <= 25, name


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name):
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
