"""The examples of docs/guides/your-own-part.md run as they stand."""

import importlib
import shlex
import sys
import tomllib
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from tests.docs.blocks import blocks_of, commands
from tests.scripts.commands import run_command

PAGE = Path(__file__).parents[1] / "docs" / "guides" / "your-own-part.md"
BLOCKS = blocks_of(PAGE)
FILES = {block.file: block.text for block in BLOCKS if block.file}
EXAMPLES = {
    str(block): block.text for block in BLOCKS if block.language == "python" and not block.file
}


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    """Save the files of the page in an empty folder, and go there."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        monkeypatch.delitem(sys.modules, Path(name).stem, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_runs(name):
    space = {"__name__": "examples"}
    exec(compile(EXAMPLES[name], name, "exec"), space)
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


def test_the_plugin_names_the_estimator():
    entries = tomllib.loads(FILES["pyproject.toml"])["project"]["entry-points"]
    (entry,) = entries["dptse_env.plugins"].values()
    module, _, function = entry.partition(":")
    getattr(importlib.import_module(module), function)()
    env = gym.make("dptse_env:dptse/ShortHighway-v0", estimator="interpolation", traffic_seeds=[0])
    env.reset(seed=0)
    env.close()


@pytest.mark.slow
def test_the_command_compares_the_estimator_with_another_one():
    line = next(line for b in BLOCKS if b.language == "bash" for line in commands(b.text))
    done = run_command(*shlex.split(line)[1:], "--workers", "1")
    assert done.returncode == 0, done.stderr
    compared = [line.split()[0] for line in done.stdout.splitlines() if "round-robin" in line]
    assert {"interpolation:Interpolation", "ekf"} <= {*compared}
