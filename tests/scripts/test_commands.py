"""All commands: their help and its examples, the status of a run, and bad input in one line."""

import errno
import io
import json
import logging
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

pytest.importorskip("tyro")

import dptse_env
from dptse_env import command_line
from dptse_env.traffic import RecordingError
from dptse_env.utils.registry import EXTRAS
from dptse_env.versions import code_version
from scripts import info
from scripts.audit import REJECTED
from scripts.dptse import MODULES
from tests.helpers import ROOT, SHORT, save_untrained
from tests.importers.data import plain, stream
from tests.importers.sumo_net.conftest import motorway
from tests.scripts.commands import ROAD, refused, run_command
from tests.scripts.test_import_policy import save_model

KINDS = ["trajectories", "network", "field", "policy"]
COMMANDS = [*MODULES, *(f"import {kind}" for kind in KINDS)]
WIDTH, HEIGHT = 100, 48
"""Columns and lines of a screen."""


@cache
def help_of(name):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", str(WIDTH))
        done = run_command(*name.split(), "--help")
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_help_begins_with_an_example_and_fits_a_screen(name):
    page = help_of(name)
    assert name == "import" or {"--json", "--quiet"} <= {*re.findall(r"--[a-z]+", page)}
    head = page.partition("╭")[0]
    assert re.search(rf"^dptse {name}\b", head, re.MULTILINE)
    lines = page.splitlines()
    assert len(lines) <= HEIGHT
    assert max(map(len, lines)) <= WIDTH


def write_data(folder):
    """Write the files that the examples name, short ones."""
    plain(folder / "points.csv", stream(seconds=130.0))
    road = "n_mainline = 4\nduration = 20\ndemand = { mainline = [[0, 1]] }\n"
    (folder / "road.toml").write_text(road)
    table = "\n".join(" ".join(["30"] * 60) for _ in range(16))
    (folder / "density.txt").write_text(table)
    (folder / "speed.txt").write_text(table.replace("30", "80"))
    motorway(folder)
    (folder / "town.sumocfg").write_text(
        '<configuration><net-file value="road.net.xml"/><route-files value="road.rou.xml"/>'
        "</configuration>"
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "import"])
def test_the_example_of_the_help_runs_as_it_is_printed(name, tmp_path, monkeypatch):
    page = help_of(name)
    line = re.search(r"^dptse ((?:.*\\\n)*.*)", page, re.MULTILINE)[1].replace("\\\n", " ")
    write_data(tmp_path)
    if name == "fit":
        (tmp_path / "my-road.toml").write_text(ROAD)
    if name == "import policy":
        save_model(tmp_path, bandwidth=1)
    if "--report" in line:
        shutil.copytree(ROOT / "results" / "paper", tmp_path / "results" / "paper")
    monkeypatch.chdir(tmp_path)
    done = run_command(*shlex.split(line))
    assert done.returncode == (REJECTED if name == "audit" else 0), done.stderr
    assert done.stdout


def test_the_overview_has_every_command_and_fits_a_terminal():
    overview = run_command("--help").stdout
    lines = overview.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    for name in MODULES:
        assert re.search(rf"^.{{16}}{name} ", overview, re.MULTILINE)
    assert run_command().stdout == run_command("help").stdout == overview
    words = "import", "field"
    assert run_command("help", *words).stdout == run_command(*words, "--help").stdout
    assert run_command("--version").stdout == f"dptse {dptse_env.__version__}\n"


def test_a_quiet_command_prints_json_alone_and_silences_nothing_after_it(caplog):
    assert run_command("info", "--quiet") == (0, "", "")
    done = run_command("info", "--quiet", "--json")
    assert "packages" in json.loads(done.stdout)
    assert done.stderr == ""
    logging.getLogger("dptse_env").warning("said")
    assert caplog.messages == ["said"]


def test_without_the_extra_it_says_what_to_install(monkeypatch, capsys):
    for name in ("scripts", "scripts.dptse"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "tyro", None)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 1
    assert "pip install 'dptse-env[train]'" in capsys.readouterr().err


def test_a_pipe_may_lack_letters(monkeypatch):
    pipe = io.TextIOWrapper(io.BytesIO(), encoding="ascii")  # as on Windows
    monkeypatch.setattr(sys, "stdout", pipe)
    monkeypatch.setattr(sys, "argv", ["dptse", "--version"])
    command_line.main()
    print("ε")
    pipe.flush()
    assert pipe.buffer.getvalue().endswith(b"?\n")


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_stream_may_be_closed(name, monkeypatch):
    monkeypatch.setattr(sys, name, None)
    monkeypatch.setattr(sys, "argv", ["dptse", "--version"])
    command_line.main()


@pytest.mark.skipif(os.name == "nt", reason="Windows removes no folder that somebody is in")
def test_a_folder_that_is_gone_is_one_line(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "error: the folder that this runs in is gone: choose another one"


def test_ctrl_c_while_the_program_loads_is_one_line(monkeypatch, capsys):
    def load(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(command_line.importlib, "import_module", load)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 130
    assert capsys.readouterr().err.split() == ["interrupted", "before", "it", "began"]


@pytest.mark.parametrize("words", [["--help"], ["info", "--help"]])
def test_a_pipe_may_be_closed_as_by_head(words):
    program = "import sys; from dptse_env.command_line import main; sys.stdin.read(); main()"
    words = [sys.executable, "-c", program, *words]
    with subprocess.Popen(
        words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as ended:
        ended.stdout.close()
        ended.stdin.close()
        assert ended.stderr.read() == b""
    assert ended.returncode == 141


def test_information_has_what_a_bug_report_needs():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [project["optional-dependencies"][name] for name in EXTRAS]
    wanted = {re.split(r"[^\w-]", each)[0] for each in sum(extras, project["dependencies"])}
    wanted -= {"dptse-env"}
    found = json.loads(run_command("info", "--json").stdout)
    assert wanted <= set(found["packages"])
    page = run_command("info").stdout
    assert code_version() in page
    assert found["packages"]["numpy"] in page
    for kept in ("records", "kernels"):
        assert re.search(rf"^{kept}: \d+ files, [\d.]+ MB in /", page, re.MULTILINE)


@pytest.mark.parametrize(
    ("problem", "status", "said"),
    [
        (ValueError("seeds must be"), 2, "error: seeds must be"),
        (FileNotFoundError(errno.ENOENT, "No such file", "a.toml"), 2, "error: a.toml: No such"),
        (OSError(errno.ENOSPC, "No space left on device", "a"), 1, "error: a: No space left"),
        (RecordingError("seed 3: SUMO"), 1, "error: seed 3: SUMO"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_the_status_says_what_happened(problem, status, said, monkeypatch):
    def collect():
        raise problem

    monkeypatch.setattr(info, "collect", collect)
    done = run_command("info")
    assert (done.returncode, done.stdout) == (status, "")
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(said)


def test_a_mistake_of_the_program_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr(info, "collect", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_command("info")


NOISE, FOLDER = bytes(range(256)), "a folder"
NETWORK = b"<configuration><input><net-file value='n.net.xml'/></inp"
TRAJECTORIES = b"<fcd-export><timestep time='0'><vehicle id='a' x='0' y='0' sp"
POINTS = "import trajectories --env SHORT --output out"
FIELD = "import field --cell 0.1 --interval 5 --segments 6 --lanes 2 --speed-limit 100 --output out"
FILES = {
    """record --records cache --env 'SHORT {"corridor": "r.toml"}'""": ("r.toml", None),
    """record --records cache --env 'SHORT {"parameters": "p.json"}'""": ("p.json", b'{"x": {'),
    """evaluate --env 'SHORT {"estimator_settings": "s.json"}' --output out""": ("s.json", NOISE),
    "evaluate --policies p.safetensors --output out": ("p.safetensors", NOISE),
    "evaluate --policies stable_baselines3:PPO=m.zip --output out": ("m.zip", FOLDER),
    "train-estimator --initial n.safetensors --output out": ("n.safetensors", NOISE),
    f"{POINTS} --format fcd --files t.xml": ("t.xml", TRAJECTORIES),
    f"{POINTS} --files x --mapping m.toml": ("m.toml", None),
    f"{FIELD} --density d.txt --speed d.txt": ("d.txt", FOLDER),
    "import network --path 'a b' --configuration a.sumocfg --output out": ("a.sumocfg", NETWORK),
    "import network --path 'a b' --net a.net.xml --output out": ("a.net.xml", FOLDER),
}
"""Commands with files that they read: a name, and a content, None where it is missing."""


@pytest.mark.parametrize("words", FILES)
def test_a_file_that_cannot_be_read_is_named(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, content = FILES[words]
    if content == FOLDER:
        Path(name).mkdir()
    elif content is not None:
        Path(name).write_bytes(content)
    line = refused(*shlex.split(words.replace("SHORT", SHORT)))
    assert name in line
    assert "[Errno" not in line
    assert {entry.name for entry in tmp_path.iterdir()} <= {name}


def test_an_unfit_policy_is_found_before_anything_is_recorded(tmp_path):
    pytest.importorskip("sb3_contrib")
    policy = save_untrained(tmp_path / "policy.safetensors", bandwidth=3)
    folders = "--output", tmp_path / "out", "--records", tmp_path / "cache"
    line = refused("evaluate", "--env", SHORT, "--policies", policy, *folders)
    assert "bandwidth is 3 for the policy and 2 for the environment" in line
    assert list(tmp_path.iterdir()) == [policy]
