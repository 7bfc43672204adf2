"""The README's Python runs as it stands, one block after the other."""

import re
from pathlib import Path

import gymnasium as gym
import pytest

from dptse_env.traffic.library import RecordLibrary

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)

pytest.importorskip("stable_baselines3")


@pytest.fixture(scope="module")
def run():
    """Return a function that runs blocks, those before it first, and returns their names."""
    env = gym.make("dptse_env:dptse/PaperHighway-v0")
    RecordLibrary().ensure(env.unwrapped.config.corridor, [*range(4), *range(2000, 2004)])
    env.reset(seed=0)  # imports and loads what the first block would
    names, done = {}, []

    def run(index):
        for block in BLOCKS[len(done) : index + 1]:
            exec(block, names)
            done.append(block)
        return names

    return run


@pytest.mark.parametrize("index", range(len(BLOCKS)))
def test_its_examples_run_one_after_the_other(run, index):
    run(index)
