"""The command: it trains, goes on, trains several seeds, and refuses."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("tyro")

from agents.training.run_files import read_progress
from scripts.training_bar import Bar, watched
from tests.agents.training.plans import SMALL, without_time
from tests.helpers import SHORT
from tests.scripts.commands import refused, run_command

ROOT = Path(__file__).parents[2]


def words(output, algorithm="plackett-luce", *more):
    settings = {**SMALL[algorithm], **({"steps": 960} if algorithm == "ppo" else {})}
    return [
        "--env", f'{SHORT} {{"horizon": 64}}', "--algorithm", f"{algorithm} {json.dumps(settings)}",
        "--traffic", "0:2", "--validation", "1000:1001", "--output", str(output), *more,
    ]  # fmt: skip


def test_it_trains_and_goes_on(tmp_path):
    done = run_command("train", *words(tmp_path / "one"))
    assert done.returncode == 0, done.stderr
    assert f"{tmp_path / 'one'}: error x 1000 in validation" in done.stdout
    before = (tmp_path / "one" / "policy.safetensors").read_bytes()
    assert run_command("train", *words(tmp_path / "one")).stdout == done.stdout
    assert (tmp_path / "one" / "policy.safetensors").read_bytes() == before
    assert "seed is 0 there and 1 now" in refused("train", *words(tmp_path / "one"), "--seeds", "1")


def test_several_seeds_are_trained_in_folders_of_their_own(tmp_path):
    given = words(tmp_path, "plackett-luce", "--seeds", "0:2", "--workers", "1")
    done = run_command("train", *given)
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == [
        str(tmp_path / seed) for seed in "01"
    ]
    first, second = (without_time(read_progress(tmp_path / seed)) for seed in "01")
    assert first[-1]["validation"] != second[-1]["validation"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals for a process")
@pytest.mark.parametrize("how", [getattr(signal, "SIGKILL", None), signal.SIGINT])
@pytest.mark.parametrize("algorithm", ["plackett-luce", "ppo"])
def test_a_killed_program_goes_on(tmp_path, how, algorithm):
    def start(output):
        return subprocess.Popen(
            [sys.executable, "-m", "scripts.dptse", "train", *words(output, algorithm)],
            cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    process = start(tmp_path / "killed")
    deadline = time.monotonic() + 240
    while not (tmp_path / "killed" / "checkpoint.pt").exists():
        assert time.monotonic() < deadline, process.communicate(timeout=5)
        time.sleep(0.01)
    process.send_signal(how)
    _, err = process.communicate(timeout=240)
    assert process.returncode == (130 if how == signal.SIGINT else -how)
    assert how == signal.SIGKILL or "the same command goes on" in err
    curves = []
    for run in ("killed", "whole"):
        process = start(tmp_path / run)
        process.communicate(timeout=600)
        assert process.returncode == 0
        curves.append(without_time(read_progress(tmp_path / run)))
    assert [row["update"] for row in curves[0]] == [row["update"] for row in curves[1]]
    if algorithm == "plackett-luce":
        assert curves[0] == curves[1]


ROWS = [{"update": k, "steps": 40 * k, "error": 0.5} for k in range(3)]


def test_the_bar_follows_the_curve(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with watched(Bar("update", ("error", "validation"), 2), tmp_path) as (bar,):
        for row in ROWS:
            bar(row)
    assert bar.bar.n == 2
    assert list(tmp_path.iterdir()) == []


def test_tensorboard_follows_the_curve_where_it_is_installed(tmp_path):
    pytest.importorskip("tensorboard")
    with watched(Bar("update", ("error",), 2), tmp_path) as (_, write):
        write(ROWS[1])
    assert list(tmp_path.glob("tensorboard/events*"))
