"""Every example runs with a few steps, as its user would run it."""

import os
import re
import shutil
import subprocess
import sys

import pytest

from tests.helpers import ROOT

pytestmark = pytest.mark.slow


def need(module):
    """Skip where a library cannot be imported."""
    code = f"import {module}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"{module} cannot be imported: {done.stderr.strip().splitlines()[-1]}")


def run(*arguments, cwd=ROOT):
    """Run Python on arguments in a folder and return what it prints."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("name", "library"),
    [
        ("sb3_ppo", "stable_baselines3"),
        ("cleanrl_ppo", "torch"),
        ("torchrl_ppo", "torchrl"),
        pytest.param("rllib_ppo", "ray.rllib.algorithms.ppo", marks=pytest.mark.ray),
    ],
)
def test_programs_that_train(name, library):
    need(library)
    printed = run(f"examples/{name}.py", "--steps", 8192)
    found = re.search(r"error x 1000: untrained (\S+), trained (\S+), rule (\S+)", printed)
    untrained, trained, rule = (float(value) for value in found.groups())
    assert untrained != trained
    assert 0.0 < rule < untrained


def test_the_demo_ends_with_four_bars_and_a_sentence(tmp_path):
    need("stable_baselines3")
    short = "--minutes", 0.05, "--test-seeds", "2000:2004", "--output", tmp_path
    printed = run("examples/demo.py", *short)
    bars = re.findall(r" (\d+\.\d) +\d+\.\d +\d+\.\d  █+$", printed, re.MULTILINE)
    errors = [float(error) for error in bars]
    assert len(errors) == 4
    assert min(errors) == errors[-1]  # with every segment queried
    side = "below" if errors[2] <= errors[1] else "above"
    assert re.search(rf"The learned policy is \d+\.\d % {side} the best rule", printed)


def test_a_schedule_of_ones_own():
    printed = run("examples/my_schedule.py")
    errors = dict(re.findall(r"(\S+) +error x 1000: (\S+)", printed))
    assert float(errors["UncertainAndOld"]) < float(errors["shift-ahead"])


def test_a_study_of_ones_own(tmp_path):
    example = ROOT / "examples" / "my_study.py"
    folder = tmp_path / "results" / "my-study"
    shutil.copy(example, tmp_path)
    run("my_study.py", cwd=tmp_path)
    first = (folder / "tables.md").read_text(encoding="utf-8")
    (folder / "tables.md").unlink()
    study = (ROOT / "scripts" / "dptse.py", "study", "examples.my_study:STUDY", "--output", folder)
    run(*study, "--report", cwd=tmp_path)
    assert (folder / "tables.md").read_text(encoding="utf-8") == first
    assert "| gain | " in first
