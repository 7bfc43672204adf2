"""The examples of docs/extending.md run as they stand."""

import re
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np

import dptse_env

SHORT = "dptse_env:dptse/ShortHighway-v0"
PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
SECTION = re.compile(r"^## ([^\n]*)\n(?:(?!^## ).)*?```python\n(.*?)```", re.DOTALL | re.MULTILINE)
EXAMPLES = dict(SECTION.findall(PAGE.read_text(encoding="utf-8")))


@cache
def run(name):
    """Return what an example defines."""
    space = {"__name__": "examples"}
    exec(compile(EXAMPLES[name], f"{PAGE.name}, {name}", "exec"), space)
    return space


def test_every_example_runs():
    assert EXAMPLES
    for space in map(run, EXAMPLES):
        if "env" not in space:
            continue
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
            assert np.isfinite([reward, info["rmse_density"]]).all()


def test_the_filter_is_worth_its_releases():
    """It errs less than the model alone, and than a filter that is told nothing."""
    own, errors = run("Estimator")["Interpolation"], {}
    for name, part, epsilon in (
        ("filter", own, 5.0),
        ("blind", own, 1e-4),
        ("model", "open_loop", 5.0),
    ):
        privacy = {"preset": "paper", "epsilon": epsilon}
        env = gym.make(SHORT, estimator=part, privacy=privacy, traffic_seeds=[0, 1])
        rows = dptse_env.evaluate(env, "round-robin", [0, 1])
        errors[name] = np.mean([row["rmse_density"] for row in rows])
    assert errors["filter"] < 0.5 * errors["model"]
    assert abs(errors["blind"] / errors["model"] - 1.0) < 0.02
