"""The command: it trains, goes on, trains several seeds, and refuses."""

import json
import re
import shlex

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("tyro")


from agents.training.run_files import read_progress
from tests.agents.training.plans import SMALL, STEPS, without_time
from tests.helpers import SHORT
from tests.scripts.commands import refused, run_command

ENV = f'{SHORT} {{"horizon": 64}}'


def words(output, algorithm="plackett-luce", *more):
    length = () if algorithm == "plackett-luce" else ("--steps", str(STEPS))
    return [
        "--env", ENV, *length,
        "--algorithm", f"{algorithm} {json.dumps(SMALL[algorithm])}",
        "--train-seeds", "0:2", "--validation-seeds", "1000:1001", "--output", str(output), *more,
    ]  # fmt: skip


def test_it_trains_and_goes_on(tmp_path):
    given = words(tmp_path / "one", "ppo")
    done = run_command("train", *given)
    assert done.returncode == 0, done.stderr
    line, next_step = done.stdout.splitlines()
    said = re.fullmatch(
        r"(.*): error x 1000 (?P<error>[\d.]+), the least of (?P<n>\d+) validations, "
        r"(?P<share>[\d.]+) % (?P<side>\w+) the best rule there, (?P<rule>[a-z-]+) "
        r"\((?P<other>[\d.]+)\), without the first 60 s",
        line,
    )
    best = str(tmp_path / "one" / "best.safetensors")
    assert said[1] == best
    rules = json.loads((tmp_path / "one" / "rules.json").read_text())
    assert int(said["n"]) == len(read_progress(tmp_path / "one"))
    rule, error, other = said["rule"], float(said["error"]), float(said["other"])
    assert rule == min(rules, key=rules.get)
    assert other == pytest.approx(1000 * rules[rule], abs=0.06)
    away = float(said["share"]) * {"below": 1, "above": -1}[said["side"]]
    assert away == pytest.approx(100 * (1 - error / other), abs=0.2)
    assert done.stderr == ""
    command = shlex.split(next_step.partition(": ")[2])
    compared = ["--policies", best, "round-robin", "--reference", rule]
    assert command == ["dptse", "evaluate", "--env", ENV, *compared]
    before = (tmp_path / "one" / "policy.safetensors").read_bytes()
    assert run_command("train", *given).stdout == done.stdout
    found = json.loads(run_command("train", *given, "--json").stdout)
    (training,), named = found["trainings"], ("policy", "best_rule")
    assert [training[name] for name in named] == [best, rule]
    assert training["error"] == pytest.approx(error / 1000, abs=6e-5)
    assert shlex.split(found["next"]) == command
    assert (tmp_path / "one" / "policy.safetensors").read_bytes() == before
    assert "seed is 0 there and 1 now" in refused("train", *given, "--seed", "1")


def test_several_seeds_are_trained_in_folders_of_their_own(tmp_path):
    given = words(tmp_path, "plackett-luce", "--seed", "0:2", "--workers", "1")
    done = run_command("train", *given)
    best = [str(tmp_path / seed / "best.safetensors") for seed in "01"]
    *lines, next_step = done.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines] == best
    assert shlex.join(["--policies", *best, "round-robin", "--reference"]) in next_step
    first, second = (without_time(read_progress(tmp_path / seed)) for seed in "01")
    assert first[-1]["validation"] != second[-1]["validation"]
