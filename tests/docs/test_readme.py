"""The README: its Python prints what stands below it, its commands train a policy that wins."""

import contextlib
import io
import re
import shlex

import pytest

from tests.helpers import ROOT
from tests.scripts.commands import run_command

from .blocks import blocks_of, commands

BLOCKS = blocks_of(ROOT / "README.md")


def test_the_python_prints_the_block_below_it():
    python = [k for k, block in enumerate(BLOCKS) if block.language == "python"]
    assert python
    for k in python:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(BLOCKS[k].text, str(BLOCKS[k]), "exec"), {})
        assert BLOCKS[k + 1].language == ""
        assert printed.getvalue() == BLOCKS[k + 1].text


@pytest.mark.slow
def test_the_commands_train_a_policy_that_beats_the_rules(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the extra train is not installed")
    monkeypatch.chdir(tmp_path)
    printed = ""
    lines = [line for block in BLOCKS if block.language == "sh" for line in commands(block.text)]
    for line in lines:
        if line.startswith("dptse "):
            done = run_command(*shlex.split(line)[1:])
            assert done.returncode == 0, done.stderr
            printed += done.stdout
    assert re.search(r"learned \(mine/best\).*: \d+\.\d % below, ", printed)
    assert all(
        (tmp_path / "mine" / "test" / name).is_file() for name in ("tables.md", "errors.png")
    )
