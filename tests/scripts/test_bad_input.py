"""Bad input and failed runs of every command: one sentence, a status, and nothing is replaced."""

import errno
import json
from pathlib import Path

import pytest

pytest.importorskip("tyro")

from dptse_env import __version__
from dptse_env.traffic import RecordingError
from scripts import dptse, info

ROOT = Path(__file__).parents[2]
SHORT = ["--env", "dptse_env:dptse/ShortHighway-v0"]
FCD = b"<fcd-export><timestep time='0'><vehicle id='a' x='0' y='0' speed='3' lane='e_0'/>"
NETWORK = b"<configuration><input><net-file value='n.net.xml'/></input></configuration>"


def run(capsys, *words):
    """Run a command; return its status, standard output and lines on standard error."""
    try:
        dptse.main(list(map(str, words)))
        status = 0
    except SystemExit as ended:
        status = ended.code or 0
    printed = capsys.readouterr()
    return status, printed.out, printed.err.splitlines()


def refused(capsys, *words, status=2):
    """Run a command that must be refused; return its one line."""
    got, out, lines = run(capsys, *words)
    assert (got, out) == (status, "")
    (line,) = lines
    assert line.startswith("error: ")
    return line


def shipped(pattern):
    """Return the content of the first file of the checkout that a pattern fits."""
    return min(ROOT.glob(pattern)).read_bytes()


PARAMETERS = shipped("dptse_env/model/sets/*.json")
PLAN = shipped("dptse_env/schedules/plans/*.json")
SETTINGS = shipped("dptse_env/estimators/tuned/*.json")
NETWORK_WEIGHTS = shipped("dptse_env/estimators/learned/shipped/*.npz")
POLICY = shipped("dptse_env/policies/*.zip")

FIELD = ["--source.cell", "0.1", "--source.interval", "5"]
ROAD = [
    "--road.name", "x", "--road.segments", "6", "--road.lanes", "2", "--road.speed-limit", "100",
]  # fmt: skip

FILES = {
    "road": ("r.toml", b"n_mainline = 'six'\n", lambda path: ["record", "--corridor", path]),
    "parameters": ("p.json", PARAMETERS, lambda path: ["evaluate", "--parameters", path]),
    "tuned parameters": ("p.json", PARAMETERS, lambda path: ["tune", "--parameters", path]),
    "settings": (
        "s.json", SETTINGS,
        lambda path: ["evaluate", "--keywords", json.dumps({"estimator_settings": str(path)})],
    ),
    "plan": ("p.json", PLAN, lambda path: ["evaluate", "--schedules", path]),
    "policy": ("p.zip", POLICY, lambda path: ["evaluate", "--policies", path]),
    "model": (
        "m.zip", POLICY, lambda path: ["suite", "--policies", f"stable_baselines3:PPO={path}"]
    ),
    "first network": (
        "n.npz", NETWORK_WEIGHTS, lambda path: ["train-estimator", "--initial", path]
    ),
    "frozen policy": (
        "p.zip", POLICY, lambda path: ["study", "policies", "freeze", "--policies", f"paper={path}"]
    ),
    "frozen settings": (
        "s.json", SETTINGS, lambda path: ["study", "policies", "freeze", "--settings", f"a={path}"]
    ),
    "trajectories": (
        "t.xml", FCD,
        lambda path: [
            "import", "trajectories", "--format", "fcd", "--corridor", "short-highway", "--files",
            path,
        ],
    ),
    "mapping": (
        "m.toml", b'format = "fcd"\n',
        lambda path: [
            "import", "trajectories", "--corridor", "short-highway", "--files", "x", "--mapping",
            path,
        ],
    ),
    "field": (
        "d.txt", b"1 2 3\n4 5 6\n",
        lambda path: [
            "import", "field", "--source.density", path, "--source.speed", path, *FIELD, *ROAD
        ],
    ),
    "replayed field": (
        "d.txt", b"1 2 3\n4 5 6\n",
        lambda path: [
            "replay-field", "--source.density", path, "--source.speed", path, *FIELD,
            "--segments", "6",
        ],
    ),
    "configuration": (
        "a.sumocfg", NETWORK,
        lambda path: ["import", "network", "--path", "a b c", "--configuration", path],
    ),
    "net": (
        "a.net.xml", b"<net version='1.9'></net>",
        lambda path: ["import", "network", "--path", "a b c", "--net", path],
    ),
}  # fmt: skip
"""Files that commands read: a name, a content, and the command."""


@pytest.mark.parametrize("how", ["missing", "folder", "noise", "truncated"])
@pytest.mark.parametrize("kind", FILES)
def test_a_file_that_cannot_be_read_is_named(kind, how, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, content, words = FILES[kind]
    path = tmp_path / name
    if how == "folder":
        path.mkdir()
    elif how != "missing":
        path.write_bytes(bytes(range(256)) if how == "noise" else content[: len(content) * 2 // 3])
    command = words(path)
    output = [] if command[0] == "replay-field" else ["--output", "out"]
    if command[:2] == ["import", "network"]:
        output = ["--output", "out.toml"]
    if command[0] == "record":
        output = ["--records", tmp_path / "cache"]
    line = refused(capsys, *command, *output)
    assert name in line
    assert "[Errno" not in line
    assert {entry.name for entry in tmp_path.iterdir()} <= {name}


ANOTHER = {"made_with": {"versions": {"dptse-env": "0.0.1"}, "settings": {}}}
FOLDERS = {
    "train": ["train", "--no-tensorboard"],
    "several": ["train", "--seeds", "0:2"],
    "train-estimator": ["train-estimator", "--no-tensorboard"],
    **{name: ["study", name, "--quick"] for name in ("paper", "privacy", "ledger", "choices")},
}
"""Commands that go on in a folder with ``run.json``."""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            json.dumps({**ANOTHER, "tuned": [], "sources": []}),
            "versions.dptse-env is '0.0.1' there",
        ),
        (json.dumps(ANOTHER), "run.json is not as this program writes it"),
        ('{"made_with": {', "run.json is not as this program writes it"),
        ("[]", "run.json is not as this program writes it"),
        (None, "is not empty and has no run.json: choose another --output"),
    ],
    ids=["version", "lacking", "truncated", "list", "foreign"],
)
@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_of_something_else_stays_as_it_is(name, content, message, tmp_path, capsys):
    pytest.importorskip("sb3_contrib")
    folder = tmp_path / "0" if name == "several" else tmp_path
    folder.mkdir(exist_ok=True)
    kept = folder / ("notes.txt" if content is None else "run.json")
    kept.write_text(content or "mine")
    line = refused(capsys, *FOLDERS[name], "--output", tmp_path)
    assert message in line
    assert kept.read_text() == (content or "mine")
    assert list(folder.iterdir()) == [kept]


def test_a_folder_of_another_study_is_refused(tmp_path, capsys):
    kept = tmp_path / "run.json"
    made_with = {"versions": {"dptse-env": __version__}, "settings": {}}
    kept.write_text(json.dumps({"made_with": made_with, "tuned": [], "sources": []}))
    line = refused(capsys, "study", "choices", "--quick", "--output", tmp_path)
    assert "cells is missing there" in line
    assert list(tmp_path.iterdir()) == [kept]


def written(folder, name):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("mine")
    return path


REPLACED = {
    "evaluate": ["evaluate", *SHORT],
    "calibrate": ["calibrate"],
    "audit": ["audit"],
    "tune": ["tune", "--estimators", "ekf", "--parameters", "w99-3lane"],
    "import network": ["import", "network"],
}
NAMES = {
    "evaluate": "episodes.csv",
    "calibrate": "fitted.json",
    "audit": "paced-worst-case-hunter.json",
    "tune": "ekf-w99-3lane-paper.json",
    "import network": "road.toml",
}


@pytest.mark.parametrize("name", REPLACED)
def test_results_are_not_replaced_without_force(name, tmp_path, capsys):
    path = written(tmp_path, NAMES[name])
    output = path if name == "import network" else tmp_path
    line = refused(capsys, *REPLACED[name], "--output", output)
    assert line == (f"error: {path} would be replaced: choose another --output, or give --force")
    assert path.read_text() == "mine"


def test_a_folder_of_records_is_never_replaced(tmp_path, capsys):
    file, content, words = FILES["trajectories"]
    (tmp_path / file).write_bytes(content)
    kept = written(tmp_path / "out", "road.toml")
    line = refused(capsys, *words(tmp_path / file), "--output", tmp_path / "out")
    assert "output must be a folder that does not exist yet" in line
    assert kept.read_text() == "mine"


def test_with_force_they_are_replaced_and_standard_output_is_json(tmp_path, capsys):
    path = written(tmp_path, "summary.json")
    words = [
        "evaluate", *SHORT, "--schedules", "paper", "--estimators", "random_walk", "--seeds",
        "2000:2002", "--workers", "1", "--output", tmp_path, "--json",
    ]  # fmt: skip
    refused(capsys, *words)
    status, out, _ = run(capsys, *words, "--force")
    assert status == 0
    assert json.loads(out) == json.loads(path.read_text())


@pytest.mark.parametrize(
    ("problem", "status", "said"),
    [
        (ValueError("seeds must be"), 2, ["error: seeds must be"]),
        (
            FileNotFoundError(errno.ENOENT, "No such file", "a.toml"),
            2,
            ["error: a.toml: No such file"],
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "a"),
            2,
            ["error: a: Permission denied"],
        ),
        (
            OSError(errno.ENOSPC, "No space left on device", "a"),
            1,
            ["error: a: No space left on device"],
        ),
        (RecordingError("seed 3: SUMO"), 1, ["error: seed 3: SUMO"]),
        (KeyboardInterrupt(), 130, ["interrupted"]),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_the_status_says_what_happened(problem, status, said, capsys, monkeypatch):
    def collect():
        raise problem

    monkeypatch.setattr(info, "collect", collect)
    assert run(capsys, "info") == (status, "", said)


def test_a_mistake_of_the_program_keeps_its_traceback(capsys, monkeypatch):
    monkeypatch.setattr(info, "collect", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(capsys, "info")


@pytest.mark.parametrize("name", [name for name in dptse.COMMANDS if name != "completion"])
def test_an_unknown_option_is_refused(name, capsys):
    status, out, lines = run(capsys, *name.split(), "--no-such-option", "1")
    assert (status, out) == (2, "")
    assert any("--no-such-option" in line for line in lines)


def test_the_page_of_commands_has_them_all():
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    for name, command in dptse.COMMANDS.items():
        assert f"| `{name}` | {command.meaning} |" in text
