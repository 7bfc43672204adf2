"""The examples of docs/guides/your-own-part.md run as they stand."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[1] / "docs" / "guides" / "your-own-part.md"
SECTION = re.compile(r"^## ([^\n]*)\n(?:(?!^## ).)*?```python\n(.*?)```", re.DOTALL | re.MULTILINE)
EXAMPLES = dict(SECTION.findall(PAGE.read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_runs(name):
    space = {"__name__": "examples"}
    exec(compile(EXAMPLES[name], f"{PAGE.name}, {name}", "exec"), space)
    if "env" not in space:
        return
    env, policy, state = space["env"], space.get("schedule"), None
    observation, info = env.reset(seed=0)
    for _ in range(20):
        if policy is None:
            action = env.action_space.sample()
        else:
            action, state = policy.predict(observation, state)
        observation, reward, *_, info = env.step(action)
        assert env.observation_space.contains(observation)
        assert np.isfinite([reward, info["rmse_density"]]).all()
