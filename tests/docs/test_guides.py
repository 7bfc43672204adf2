"""Guides whose blocks run from top to bottom in an empty folder, on less data."""

import contextlib
import importlib.util
import io
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dptse_env import RoadEstimator
from dptse_env.policies import read_policy
from dptse_env.traffic import read_corridor
from tests.helpers import ROOT
from tests.scripts.commands import run_command

from .blocks import blocks_of, commands

FIT = "--trials 1 --estimators ekf --policies round-robin --workers 1"
SEEDS = "--train-seeds 0:2 --validation-seeds 1000:1002 --test-seeds 2000:2002"
GUIDES = {
    "train-a-policy.md": {
        "--minutes 8": "--steps 8192 --train-seeds 0:2 --validation-seeds 1000:1002",
        "--test-seeds 2000:2032": "--test-seeds 2000:2002 --workers 1",
        "dptse evaluate --suite --policies": "dptse evaluate --suite short-printed --policies",
        '"0:64"': '"0:2"',
        "1_000_000": "8192",
        'num_envs=8, traffic_seeds="2000:2008"': 'num_envs=2, traffic_seeds="2000:2002"',
        "range(2000, 2008)": "range(2000, 2002)",
    },
    "compare-policies.md": {
        "--fresh 8": "--fresh 2 --workers 1",
        "--test-seeds 1000:1064": "--test-seeds 1000:1002 --workers 1",
    },
    "your-road.md": {
        "dptse fit my-road.toml": f"dptse fit my-road.toml {FIT} {SEEDS}",
        "--steps 300000 --train-seeds 0:8 --validation-seeds 1000:1008": (
            "--steps 8192 --train-seeds 0:2 --validation-seeds 1000:1002"
        ),
        "--test-seeds 2000:2016": "--test-seeds 2000:2002 --workers 1",
    },
    "your-network.md": {"dptse fit town/road.toml": f"dptse fit town/road.toml {FIT} {SEEDS}"},
    "many-machines.md": {
        "--executor ray --address auto": "--executor local --workers 1",
        "--test-seeds 2000:2032": "--test-seeds 2000:2002",
        "dptse audit": "dptse audit --trials 100 --env dptse_env:dptse/ShortHighway-v0",
    },
    "audit.md": {"--trials 500": "--trials 100 --workers 1", "--one-run": "--one-run --workers 1"},
    "guarantee.md": {},
    "your-own-stream.md": {'("recurrent", "asm", "ekf")': '("asm",)'},
}
"""Guides with commands, and passages of each with what runs in their place."""


class Ran(NamedTuple):
    """The output of a guide's blocks, and the names of its Python."""

    printed: str
    names: dict[str, Any]


@pytest.fixture
def run_guide(tmp_path, monkeypatch):
    """Return a function that runs the blocks of a guide in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("mine", "mynet"):
        monkeypatch.delitem(sys.modules, module, raising=False)

    def run(guide: str) -> Ran:
        names, printed, replaced = {"__name__": "documentation"}, io.StringIO(), set()
        (page,) = (ROOT / "docs").rglob(guide)
        for block in blocks_of(page):
            text = block.text
            for whole, part in GUIDES[guide].items():
                replaced |= {whole} if whole in text else set()
                text = text.replace(whole, part)
            if block.file:
                Path(block.file).write_text(text, encoding="utf-8")
            elif block.language == "python":
                with contextlib.redirect_stdout(printed):
                    exec(compile(text, str(block), "exec"), names)
            elif block.language == "bash":
                printed.writelines(run_line(line) for line in commands(text))
        assert replaced == {*GUIDES[guide]}
        return Ran(printed.getvalue(), names)

    return run


def run_line(line: str) -> str:
    """Run a command line of the package or of SUMO; others are those of an installation."""
    program, *words = shlex.split(line, comments=True)
    if program == "netconvert":
        command = [str(Path(sys.executable).with_name(program)), *words]
        subprocess.run(command, check=True, capture_output=True)
    if program != "dptse":
        return ""
    done = run_command(*words)
    assert done.returncode == (3 if "verdict: rejected" in done.stdout else 0), done.stderr
    return done.stdout


def need(module: str) -> None:
    """Skip a test whose extra is not installed."""
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed")


@pytest.mark.slow
def test_entries_are_compared_checked_and_played_on_fresh_traffic(run_guide):
    printed, _ = run_guide("compare-policies.md")
    assert "query-suite-v4, errors x 1000 from second 61 on" in printed
    card = json.loads(Path("results/fresh/card.json").read_text())
    assert len(card["fresh"]) == 2


@pytest.mark.slow
def test_a_policy_is_trained_compared_and_entered_in_the_suite(run_guide):
    need("stable_baselines3")
    printed, names = run_guide("train-a-policy.md")
    assert re.search(r"% (below|above)", printed)
    assert all(Path(name).is_file() for name in ("mine/curve.png", "mine/test/space_time.png"))
    for name in ("mine/best", "mynet-Net"):
        card = json.loads(Path("results/my-suite", name, "card.json").read_text())
        assert card["policies"].keys() == {"short-printed"}
    observation = names["envs"].reset(seed=0)[0]
    loaded, imported = (
        names["load_policy"](file, names["unseen"]).predict(observation, deterministic=True)[0]
        for file in ("mlp.safetensors", "imported/policy.safetensors")
    )
    assert (loaded == imported).all()
    assert read_policy("continued/best.safetensors").card["policy"]["class"] == "RoadPolicy"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_a_road_file_becomes_a_compared_policy(run_guide):
    need("stable_baselines3")
    printed, _ = run_guide("your-road.md")
    chosen = tomllib.loads(Path("my-road.toml").read_text(encoding="utf-8"))["environment"]
    assert f"Settings of {chosen['estimator']}: " in printed
    page = Path("my-road-fit/fit.md").read_text(encoding="utf-8")
    assert all(each in page for each in ("dptse train", "dptse evaluate", "dptse fit --tune"))
    assert "best" in Path("my-road-fit/comparison/tables.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_network_becomes_a_fitted_road(run_guide):
    need("sumo")
    printed, _ = run_guide("your-network.md")
    assert "on-ramp at face 4: on" in printed
    road = read_corridor("town/road.toml")
    assert (road.geometry.n_mainline, road.geometry.off_ramps) == (15, (11,))
    assert Path("town/road-fit/fit.md").is_file()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_a_stream_is_followed_and_compared_with_straight_lines(run_guide):
    need("polars")
    printed, names = run_guide("your-own-stream.md")
    assert names["again"].time == 1800
    assert re.search(r"^asm: \d+\.\d km/h, (no )?better than straight lines, ", printed, re.M)
    gaps = names["table"].sample(fraction=0.9, seed=0).sort("second", "km")
    road = partial(RoadEstimator, "motorway.toml", "random_walk", start=names["start"])
    errors = names["left_out"](gaps, lambda _: road())
    assert np.isfinite(errors).all()


@pytest.mark.slow
def test_jobs_for_many_machines_run_on_one(run_guide):
    printed, _ = run_guide("many-machines.md")
    assert "speed-front" in printed
    assert "verdict: " in printed
    assert Path("results/many/tables.md").is_file()


@pytest.mark.slow
def test_an_audit_rejects_the_mechanism_of_the_page_and_not_a_sound_one(run_guide):
    printed, _ = run_guide("audit.md")
    verdicts = re.findall(r"verdict: (not rejected|rejected)", printed)
    assert verdicts == ["rejected", "not rejected"]


def test_the_page_on_the_guarantee_prints_its_tables(run_guide):
    printed, _ = run_guide("guarantee.md")
    assert "2.119-Gaussian differential privacy" in printed
    assert re.search(r"250 trips: mu 16\.134, epsilon 198\.1", printed)


def test_the_picture_of_the_network_shows_the_import_of_the_guide(tmp_path):
    drawing = runpy.run_path(str(ROOT / "docs" / "_site" / "guides.py"))
    drawing["write_files"]("your-network.md", tmp_path)
    assert {path.suffixes[0] for path in tmp_path.iterdir()} == {".nod", ".edg", ".rou"}
    page = (ROOT / "docs" / "guides" / "your-network.md").read_text(encoding="utf-8")
    assert f'--path "{" ... ".join(drawing["PATH"])}"' in page
    assert f"--segment-length {drawing['SEGMENT_LENGTH']:.0f} " in page
