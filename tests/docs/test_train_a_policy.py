"""The page on training, whose blocks run from top to bottom in an empty folder, on less data."""

import contextlib
import io
import json
import re
import shlex

import pytest

from dptse_env.policies import read_policy
from tests.scripts.commands import run_command

from .blocks import ROOT, blocks_of
from .test_blocks import commands

LESS = {
    "--minutes 8": "--steps 8192 --traffic 0:2 --validation 1000:1002",
    "--seeds 2000:2032": "--seeds 2000:2002 --workers 1",
    "dptse suite mine/best.safetensors": "dptse suite mine/best.safetensors --cells short",
    '"0:64"': '"0:2"',
    "1_000_000": "8192",
    'num_envs=8, traffic_seeds="2000:2008"': 'num_envs=2, traffic_seeds="2000:2002"',
    "range(2000, 2008)": "range(2000, 2002)",
}
"""Passages of the page, and those that are run in their place."""


@pytest.mark.slow
def test_the_page_trains_compares_and_enters_the_suite(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the extra train is not installed")
    monkeypatch.chdir(tmp_path)
    names, printed, replaced = {"__name__": "documentation"}, io.StringIO(), set()
    for block in blocks_of(ROOT / "docs" / "guides" / "train-a-policy.md"):
        text = block.text
        for whole, part in LESS.items():
            replaced |= {whole} if whole in text else set()
            text = text.replace(whole, part)
        if block.language == "python":
            with contextlib.redirect_stdout(printed):
                exec(compile(text, str(block), "exec"), names)
        else:
            for line in commands(text):
                done = run_command(*shlex.split(line)[1:])
                assert done.returncode == 0, done.stderr
                printed.write(done.stdout)
    assert replaced == {*LESS}
    assert re.search(r"% (below|above)", printed.getvalue())
    pictures = ("mine/curve.png", "mine/test/space_time.png")
    assert all((tmp_path / picture).is_file() for picture in pictures)
    card = json.loads(next(tmp_path.glob("results/my-suite/**/card.json")).read_text())
    assert card["scores"].keys() == {"short"}
    observation = names["envs"].reset(seed=0)[0]
    loaded, imported = (
        names["load_policy"](file, names["unseen"]).predict(observation, deterministic=True)[0]
        for file in ("mlp.safetensors", "imported.safetensors")
    )
    assert (loaded == imported).all()
    assert read_policy("continued/best.safetensors").card["policy"]["class"] == "RoadPolicy"
    names["shaped"].reset(seed=0)
    assert (names["shaped"].step(names["shaped"].action_space.sample())[1] < 0.0).all()
