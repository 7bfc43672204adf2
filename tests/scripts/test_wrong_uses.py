"""Wrong uses of every command: one line with path and value, before any work, and nothing is left.

``SHORT`` in words is the id of the smallest environment, and ``…`` in a text stands for anything.
"""

import re
import shlex
import sys

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("tyro")

from dptse_env.traffic import library
from tests.helpers import SHORT
from tests.importers.data import plain, stream
from tests.importers.sumo_net.conftest import motorway
from tests.scripts.commands import ROAD, run_command
from tests.scripts.test_outputs import begin

USES = {
    "": {
        "recrod": "recrod … evaluate … record",
        "help recrod": "recrod … no command",
        "study": "Missing from dptse study: NAME",
        "import": "Expected one of {trajectories",
        "import field --lanes 3": "Missing from dptse import field: --output PATH",
    },
    "evaluate --env SHORT --output out": {
        "--policies best": "schedule must be … best",
        "--policies nobody.safetensors": "nobody.safetensors",
        "--policies a/b.safetensors c/a/b.safetensors": "'a/b'",
        "--policies junk": "junk",
        "--reference nobody": "'nobody'",
        "--estimators kf": "estimator must be … kf",
        "--seed -1": "seed must be … -1",
        """--env 'SHORT {"estimator_settings": {"process_noise": [0, 0]}}' --estimators ekf mhe""":
            "estimator_settings.process_noise[0] … 0",  # the first could be played
        "--test-seeds 2000:2000": "test_seeds must be … 2000:2000",
        """--env 'SHORT {"horizon": 60}'""": "horizon … 60",
        """--env 'SHORT {"records": "mine"}'""": "env.records must be left out",
        """--env 'SHORT {"traffic_seeds": "0:2"}'""": "env.traffic_seeds must be left out",
        "--workers 99999999999999": "workers … 1..10000 … 99999999999999",
        "--beside card.json": "--beside must be left out",
        "--address auto": "address must be … 'auto'",
    },
    "record --records cache": {
        "--sed 0:1": "--sed, 0:1",
        "--workers x": "--workers",
        "--env SHORT": "--train-seeds … --validation-seeds … --test-seeds",
        "--env SHORT --seeds 0:4": "--seeds",
        "--env SHORT --train-seeds 0:2 --validation-seeds 0:4":
            "validation_seeds must be … 1000..1999 … 0",
        "--train-seeds 3:1": "train_seeds must be … 3:1",
    },
    "train --env SHORT --output out": {
        "--algorithm dqn": "algorithm must be one of ppo, … plackett-luce where bandwidth … dqn",
        "--minutes 0": "minutes must be … 0",
        "--steps -3": "steps must be … -3",
        "--train-seeds 998:1001": "train_seeds must be … 0..999 … 1000",
        "--validation-seeds 2000": "validation_seeds must be … 1000..1999 … 2000",
        "--env": "env must be … ()",
    },
    "train-estimator --rounds ekf:1:2 --initial None --output out": {
        "--train-seeds 0:2000": "train_seeds must be … 0..999",
        "--kinds x": "'flows', 'speeds'",
        "--rounds own": "rounds must be … 'own'",
        "--rounds own:a:4": "rounds must be … 'own:a:4'",
        "--rounds own:-1:4": "rounds must be … 'own:-1:4'",
        "--rounds own:0:4": "rounds.scenarios must be … 0",
        "--initial nowhere": "initial: … highway … nowhere",
        "--plan [3]": "plan must be … 3",
        "--plan {": "plan must be JSON: ",
        """--plan '{"wide": 3}'""": "plan.wide is unknown",
        """--plan '{"ranges": {"sections": 2}}'""": "plan.ranges.sections must be … 2",
        """--plan '{"seconds": 241}' --env SHORT""": "plan.seconds … 240 s … 241",
    },
    "fit --tune --estimators random_walk --env SHORT --output out --trials 3": {
        "--workers 0": "workers must be … 0",
        "--trials 0": "trials must be … 0",
        "--policies random round-robin": "policies must be",
        "--train-seeds 2000:2008": "train_seeds must be … 2000",
        "--test-seeds 2000:2008": "--test-seeds must be left out",
        "--keep-fitted": "--keep-fitted must be left out",
        "--estimators recurrent": "estimators must be … recurrent",
        "--also demand": "also must leave out demand … random_walk",
        """--env 'SHORT {"estimator": "ukf"}'""": "env.estimator must be left out",
        """--env 'SHORT {"cargo": 1}'""": "cargo",
        """my-road.toml --env 'SHORT {"corridor": {}}'""": "env.corridor must be left out",
    },
    "fit": {
        "": "road must be given",
        "my-road.toml --also demand": "--also must be left out without --tune",
        "my-road.toml --seed 1": "--seed must be left out without --tune",
        "my-road.toml --force": "--force must be left out without --tune",
        "road.json": "road must be a road file",
        "nowhere.toml": "nowhere.toml",
        "my-road.toml --test-seeds 1000:1004": "test_seeds must be … 2000..2999 … 1000",
        """my-road.toml --env 'dptse_env:dptse/PrivateHighway-v1 {"parameters": "published"}'""":
            "env.parameters must be left out",
        "my-road.toml --estimators kalman": "estimator must be one of … kalman",
        "my-road.toml --policies all": "schedule 'all' needs bandwidth 4",
        "my-road.toml --policies nobody.safetensors": "nobody.safetensors",
    },
    "study --output out": {
        "moon": "study must be … 'moon'",
        "no_such_module:STUDY": "'no_such_module:STUDY'",
        "examples.my_study:CELLS": "must be a Study, got tuple",
        """'examples.my_study:STUDY {"minutes": 1}'""": "examples.my_study:STUDY must be none",
        """'roads {"minutes": 1}'""": "roads … 'minutes'",
        """'roads {"weights": [3]}'""": "weights … 3",
        """'roads {"weights"}'""": "study must be JSON",
        "'roads 3'": "study must be … '3'",
        "tests.scripts.test_study:numbered": "numbered takes number: missing",
        """'tests.scripts.test_study:numbered {"number": 0}'""": "must be a Study, got int",
        "examples.my_study:STUDY --test-seeds all": "test_seeds must be … 'all'",
        "examples.my_study:STUDY --env dptse_env:dptse/ShortHighway-v0 --report":
            "env must be left out",
        "examples.my_study:STUDY --workers 0": "workers must be … 0",
        "examples.my_study:STUDY --report": "rows.parquet",
        """examples.my_study:STUDY --env 'SHORT {"bandwidth": 1}'""": "env must be of",
        "examples.my_study:STUDY --env dptse_env:dptse/LongHighway-v0": "env must be of",
    },
    "audit --env SHORT --output out --records cache": {
        "--target everyone": "target must be … everyone",
        """--target opposite --env 'SHORT {"privacy": "capped"}'""": "target must be … opposite",
        "--trials 1": "trials must be … 1",
        """--env 'SHORT {"records": "mine"}'""": "env.records must be left out",
        "--noise-factor 0": "noise_factor must be … 0",
        "--one-run --target deleted": "--target must be left out with --one-run",
        "--one-run --trials 6000": "--trials must be left out with --one-run",
        """--env 'SHORT {"privacy": {"preset": "paced", "cap": 9}}'""": "privacy.cap is unknown",
        "--address auto": "address must be … 'auto'",
        "--executor ray": "pip install 'dptse-env[ray]'",
    },
    "import trajectories --files points.csv --output out --env SHORT": {
        "": "format must be",
        "--format xls": "source.format must be … xls",
        "--format table --columns t": "columns must be … 't'",
        "--format table --units length=yd": "source.units.length must be … yd",
        "--format table --shares 1 1 0": "shares must be",
    },
    "import network --output out": {
        "--path in": "net must be given",
        "--net road.net.xml": "path must be",
        "--net road.net.xml --path 'in ... on out'": "path must be",
        "--net road.net.xml --path on": "path: … road.net.xml",
        "--net road.net.xml --path in --output …": "output must be",
    },
    "import policy model.zip --output out --trust": {
        "--env SHORT": "model.zip",
        "--env nope": "env must be … nope",
        "--env 'SHORT [1]'": "env must be … [1]",
        """--env 'SHORT {"bandwidth": 9}'""": "bandwidth must be … 9",
        "--env SHORT --output my-road.toml": "output must be … my-road.toml",
    },
}  # fmt: skip
"""By the beginning of a line of ``dptse`` its other words, with what the error names."""

ENVIRONMENTS = {
    "dptse_env:dptse/Nowhere-v0": "env must be",
    "no_such_module:dptse/PaperHighway-v0": "env must be",
    "CartPole-v1": "env must be",
    f"{SHORT} 3": "env must be … '3'",
    f"{SHORT} {'[' * 100_000}": "env must be JSON: maximum recursion depth",
    f'{SHORT} {{"epsilon": {"9" * 5000}}}': "env must be JSON: Exceeds the limit",
    f'{SHORT} {{"cargo": 1}}': "cargo",
    f'{SHORT} {{"corridor": {{"duration": -3}}}}': "corridor.duration must be … -3",
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files that words name."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "my-road.toml").write_text(ROAD)
    (folder / "model.zip").touch()
    plain(folder / "points.csv", stream(seconds=30.0))
    motorway(folder)
    return folder


def wrong(uses, files, monkeypatch):
    """Check that lines of words, with what each is to name, are refused before any work."""
    monkeypatch.chdir(files)
    monkeypatch.setenv("DPTSE_CACHE", "cache")
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr(library, "record_seeds", begin)
    before, lived = sorted(files.iterdir()), []
    for words, said in uses:
        named = ".*".join(map(re.escape, said.split(" … ")))
        status, out, told = run_command(*words)
        if status not in (1, 2) or out or not re.fullmatch(f"error: .*{named}.*\n", told):
            lived.append((*words, status, out, told))
        assert sorted(files.iterdir()) == before, words
    assert not lived


@pytest.mark.parametrize("command", USES)
def test_a_wrong_use_is_one_line_with_path_and_value_and_leaves_nothing(
    command, files, monkeypatch
):
    start = shlex.split(command.replace("SHORT", SHORT))
    uses = [
        ([*start, *shlex.split(more.replace("SHORT", SHORT))], said)
        for more, said in USES[command].items()
    ]
    wrong(uses, files, monkeypatch)


@pytest.mark.parametrize("command", ["record", "evaluate", "audit"])
def test_what_is_wrong_with_an_environment_is_said_by_its_path(command, files, monkeypatch):
    uses = [((command, "--env", env), said) for env, said in ENVIRONMENTS.items()]
    wrong(uses, files, monkeypatch)
