"""The commands of ``dptse``."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytest.importorskip("tyro")

import dptse_env
from dptse_env import command_line
from dptse_env.utils.registry import EXTRAS
from scripts import dptse
from scripts.dptse import COMMANDS, as_commands
from tests.helpers import fast_and_slow

SCRIPTS = Path(dptse.__file__).parent
LIBRARIES = {"cli", "dptse", "document_configuration", "training_bar", "__init__"}


def test_every_script_is_a_command():
    modules = {path.stem for path in SCRIPTS.glob("*.py")} - LIBRARIES
    assert {command.module for command in COMMANDS.values()} == modules


HELP = ["train", "import network", "evaluate"]
"""Commands with arguments in groups, of two words, and the longest one; the others are slow."""


@pytest.mark.parametrize(
    "name", fast_and_slow([name for name in COMMANDS if name != "completion"], HELP)
)
def test_every_command_has_a_page_of_help(name, capsys):
    with pytest.raises(SystemExit) as ended:
        dptse.main([*name.split(), "--help"])
    assert ended.value.code == 0
    page = capsys.readouterr().out
    assert page.startswith(f"usage: dptse {name}")
    assert "python scripts/" not in page


def test_the_overview_names_every_command(capsys):
    dptse.main([])
    page = capsys.readouterr().out
    assert all(f"  {name} " in page for name in COMMANDS)
    dptse.main(["--help"])
    assert capsys.readouterr().out == page


def test_the_version_is_that_of_the_package(capsys):
    dptse.main(["--version"])
    assert capsys.readouterr().out == f"dptse {dptse_env.__version__}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["recrod"], "error: there is no command 'recrod', did you mean 'record'?"),
        (["import", "netwrk"], "no command 'import netwrk', did you mean 'import network'?"),
        (["impot", "network"], "no command 'impot', did you mean 'import network'?"),
        (["evalaute", "--html"], "no command 'evalaute', did you mean 'evaluate'?"),
        (["xyzzy"], "error: there is no command 'xyzzy' See dptse --help."),
    ],
)
def test_an_unknown_command_suggests_the_nearest(words, message, capsys):
    with pytest.raises(SystemExit) as ended:
        dptse.main(words)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_a_group_shows_its_commands(capsys):
    with pytest.raises(SystemExit) as ended:
        dptse.main(["import"])
    assert ended.value.code == 2
    page = capsys.readouterr().out
    assert "import trajectories" in page
    assert "calibrate" not in page


def test_an_unknown_option_suggests_the_nearest(capsys):
    with pytest.raises(SystemExit) as ended:
        dptse.main(["record", "--sed", "0:1"])
    assert ended.value.code == 2
    assert "--seeds" in capsys.readouterr().err


def test_bad_input_is_one_line(capsys):
    with pytest.raises(SystemExit) as ended:
        dptse.main(["record", "--seeds", "3:1"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("error: seeds")


def test_information_for_programs_and_people(capsys):
    dptse.main(["info", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["dptse-env"] == dptse_env.__version__
    assert found["packages"]["numpy"]
    assert "dptse/PaperHighway-v0" in found["environments"]
    dptse.main(["info"])
    page = capsys.readouterr().out
    assert found["digest"] in page
    assert found["packages"]["gymnasium"] in page


def test_information_names_all_that_is_required(capsys):
    text = (Path(dptse_env.__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    extras = [project["optional-dependencies"][name] for name in EXTRAS]
    wanted = {re.split(r"[^\w-]", each)[0] for each in sum(extras, project["dependencies"])}
    dptse.main(["info", "--json"])
    assert wanted - set(json.loads(capsys.readouterr().out)["packages"]) == set()


def test_records_for_programs(tmp_path, capsys):
    corridor = ["--corridor", "short-highway", "--records", str(tmp_path)]
    dptse.main(["record", *corridor, "--seeds", "0:2", "--workers", "1", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["seeds"] == [0, 1]
    names = sorted(path.name for path in Path(found["folder"]).glob("0*"))
    assert names == ["00000000.safetensors", "00000001.safetensors"]


def test_scripts_are_named_as_commands():
    text = "python scripts/train_estimator.py --seed 0\npython scripts/document_configuration.py"
    assert as_commands(text) == (
        "dptse train-estimator --seed 0\npython scripts/document_configuration.py"
    )


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_completes_commands_and_options(shell, capsys):
    with pytest.raises(SystemExit) as ended:
        dptse.main(["completion", shell])
    assert ended.value.code in (0, None)
    script = capsys.readouterr().out
    for word in ("train-estimator", "trajectories", "--seeds", "--bandwidth"):
        assert word in script


def test_without_the_extra_it_says_what_to_install(monkeypatch, capsys):
    for name in ("scripts", "scripts.dptse"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "tyro", None)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 1
    assert "pip install 'dptse-env[train]'" in capsys.readouterr().err


def test_tools_of_a_wheel_come_first_on_the_path(tmp_path, monkeypatch):
    (tmp_path / "scripts").mkdir()
    monkeypatch.setattr(command_line, "TOOLS", tmp_path)
    monkeypatch.setattr(sys, "path", ["elsewhere"])
    command_line.add_tools_path()
    command_line.add_tools_path()
    assert sys.path == [str(tmp_path), "elsewhere"]


def test_it_runs_as_a_program(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", "import dptse_env.command_line as c; c.main()", "--version"],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    assert done.stdout.startswith("dptse ")
