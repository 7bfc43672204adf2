"""Calibration by the command."""

import json

import pytest

from dptse_env.model.parameters import read_parameters
from scripts.cli import Environment
from tests.helpers import SHORT
from tests.scripts.commands import refused, run_command

PAPER = "dptse_env:dptse/PaperHighway-v0"


def test_it_fits_on_some_seeds_and_reports_on_others(tmp_path):
    done = run_command(
        "calibrate", "--env", f'{SHORT} {{"corridor": {{"name": "mine"}}}}', "--train", "0:2",
        "--held-out", "1000:1001", "--max-evaluations", "20", "--workers", "1",
        "--output", tmp_path / "deep" / "out",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    path = tmp_path / "deep" / "out" / "fitted.json"
    parameters = read_parameters(path)
    assert (parameters.lanes, parameters.derived_from) == (2, "w99-3lane")
    provenance = json.loads(path.read_text())["provenance"]
    errors = provenance["held_out_errors"]
    for name in ("persistence", "paper", "w99-3lane", "fitted"):
        assert name in done.stdout
        assert len(errors[name]["density"]) == len(errors[name]["horizons"])
    assert errors["fitted"]["density"][-1] < errors["persistence"]["density"][-1]
    assert (provenance["corridor"], provenance["train"]) == ("mine", "0:2")


@pytest.mark.parametrize("length", [0.05, 0.04])
def test_a_road_may_have_segments_too_short_for_the_default_parameters(length):
    road = Environment(f'{PAPER} {{"corridor": {{"segment_length": {length}}}}}').corridor()
    assert road.segment_lengths[0] == length


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--held-out", "1:3"], "held_out must not share seeds with train, both have [1]"),
        (["--env", f'{PAPER} {{"corridor": {{"length": 1}}}}'], "corridor.length"),
        (["--train", "x"], "train must be 'first:stop' or one seed, got 'x'"),
    ],
)
def test_bad_arguments_are_named(words, message, tmp_path):
    line = refused("calibrate", "--output", tmp_path / "out", "--train", "0:2", *words)
    assert message in line
    assert not (tmp_path / "out").exists()
