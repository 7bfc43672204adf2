"""Variables of the environment, which no other test sees, change no number."""

import os
import re
import subprocess
import sys

from tests.helpers import ROOT

PROGRAM = """
import gymnasium as gym
from agents.terminal import make_table, print_table
env = gym.make("dptse_env:dptse/ShortHighway-v0", traffic_seeds=[0], horizon=4)
env.reset(seed=0)
env.action_space.seed(0)
table = make_table("title", *"abcd")
table.add_row(*[f"{env.step(env.action_space.sample())[1]:.9f}" for _ in range(4)])
print_table(table)
"""
NO_EFFECT = {
    "COLUMNS": "20", "LC_ALL": "C", "LINES": "5", "MPLBACKEND": "none", "NO_COLOR": "1",
    "OMP_NUM_THREADS": "2", "PYTHONHASHSEED": "7", "RAY_ADDRESS": "10.0.0.1:1",
    "SUMO_HOME": "/nowhere", "TERM": "dumb", "TQDM_DISABLE": "1", "TZ": "Asia/Kolkata",
}  # fmt: skip


def test_variables_change_no_number(tmp_path, capsys):
    exec(PROGRAM, {})
    expected = capsys.readouterr().out
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, check=True,
        env={**os.environ, **NO_EFFECT, "DPTSE_CACHE": str(tmp_path), "PYTHONUTF8": "1"},
        encoding="utf-8",
    )  # fmt: skip
    assert len(list(tmp_path.rglob("*.safetensors"))) == 1
    numbers, said = (re.findall(r"\d\.\d{9}", text) for text in (expected, done.stdout))
    assert said == numbers
    assert len(said) == 4
