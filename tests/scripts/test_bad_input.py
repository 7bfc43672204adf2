"""Bad input and failed runs: one line, a status, and nothing is played, recorded or replaced."""

import errno
import json
import re
from pathlib import Path

import pytest

pytest.importorskip("tyro")

from dptse_env.traffic import RecordingError
from scripts import dptse, info
from tests.helpers import fast_and_slow
from tests.scripts.commands import ROOT, refused, run_script

SHORT = "dptse_env:dptse/ShortHighway-v0"


def shipped(pattern):
    """Return the content of the first file of the checkout that a pattern fits."""
    return min(ROOT.glob(pattern)).read_bytes()


PARAMETERS = shipped("dptse_env/model/sets/*.json")
SETTINGS = b'{"x": {"estimator": "ekf", "settings": {"count_noise": 1}, "provenance": {}}}'
POLICY = shipped("dptse_env/policies/*.safetensors")
FCD = b"<fcd-export><timestep time='0'><vehicle id='a' x='0' y='0' speed='3' lane='e_0'/>"
NETWORK = b"<configuration><input><net-file value='n.net.xml'/></input></configuration>"
FIELD = ["--source.cell", "0.1", "--source.interval", "5"]
ROAD = [
    "--road.name", "x", "--road.segments", "6", "--road.lanes", "2", "--road.speed-limit", "100",
]  # fmt: skip
FILES = {
    "road": ("r.toml", b"n_mainline = 'six'\n", ["record", "--corridor"]),
    "parameters": ("p.json", PARAMETERS, ["tune", "--parameters"]),
    "settings": (
        "s.json", SETTINGS,
        ["evaluate", "--keywords", '{{"estimator_settings": "{path}"}}'],
    ),
    "policy": ("p.safetensors", POLICY, ["tune", "--schedule"]),
    "model": ("m.zip", POLICY, ["evaluate", "--policies", "stable_baselines3:PPO={path}"]),
    "network": (
        "n.safetensors", shipped("dptse_env/estimators/networks/*.safetensors"),
        ["train_estimator", "--initial"],
    ),
    "trajectories": (
        "t.xml", FCD,
        [
            "import_road", "trajectories", "--format", "fcd", "--corridor", "short-highway",
            "--files",
        ],
    ),
    "mapping": (
        "m.toml", b'format = "fcd"\n',
        ["import_road", "trajectories", "--corridor", "short-highway", "--files", "x", "--mapping"],
    ),
    "field": (
        "d.txt", b"1 2 3\n4 5 6\n",
        ["import_road", "field", *FIELD, *ROAD, "--source.density", "{path}", "--source.speed"],
    ),
    "replayed field": (
        "d.txt", b"1 2 3\n4 5 6\n",
        ["replay_field", *FIELD, "--segments", "6", "--source.density", "{path}", "--source.speed"],
    ),
    "configuration": (
        "a.sumocfg", NETWORK, ["import_network", "--path", "a b c", "--configuration"]
    ),
    "net": (
        "a.net.xml", b"<net version='1.9'></net>", ["import_network", "--path", "a b c", "--net"]
    ),
}  # fmt: skip
"""Files that commands read: a name, a content, and the command; the path comes last or inside."""

OUTPUTS = {
    "replay_field": [], "record": ["--records", "cache"], "import_network": ["--output", "o.toml"],
}  # fmt: skip
FAST = [
    ("road", "missing"), ("policy", "truncated"), ("network", "noise"), ("net", "folder"),
    ("trajectories", "truncated"), ("replayed field", "folder"),
]  # fmt: skip
ALL = [(kind, how) for kind in FILES for how in ("missing", "folder", "noise", "truncated")]


@pytest.mark.parametrize(("kind", "how"), fast_and_slow(ALL, FAST))
def test_a_file_that_cannot_be_read_is_named(kind, how, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, content, (script, *words) = FILES[kind]
    path = tmp_path / name
    if how == "folder":
        path.mkdir()
    elif how != "missing":
        path.write_bytes(bytes(range(256)) if how == "noise" else content[: len(content) * 2 // 3])
    given = [word.format(path=path) for word in words]
    if given == words or "density" in " ".join(words):
        given.append(path)
    line = refused(script, *given, *OUTPUTS.get(script, ["--output", "out"]))
    assert name in line
    assert "[Errno" not in line
    assert {entry.name for entry in tmp_path.iterdir()} <= {name}


def recurrent(weights):
    settings = {"recurrent": {"weights": weights}}
    return json.dumps({"estimator": "recurrent", "estimator_settings": settings})


REFUSED = {
    "unknown schedule": (
        ["tune", "--env", SHORT, "--schedule", "best"], "schedule must be one of .*, got 'best'",
    ),
    "unfit policy": (
        ["tune", "--env", SHORT, "--schedule", "{policy}"], "bandwidth is 3 for the policy and 2",
    ),
    "refused estimator": (
        ["train", "--env", SHORT, "--keywords", recurrent("highway-flows"), "--traffic", "0:1"],
        "were trained on flows in",
    ),
    "unknown estimator of a round": (
        ["train_estimator", "--ranges.envs", SHORT, "--rounds", "kf:1:1"],
        "estimator must be one of .*, got 'kf'",
    ),
    "unknown schedule of scenarios": (
        ["train_estimator", "--ranges.envs", SHORT, "--ranges.schedules", "best"],
        "schedule must be one of .*, got 'best'",
    ),
    "refused estimator of an audit": (
        ["audit", "--env", SHORT, "--privacy", "paced", "--keywords", recurrent("highway-speeds")],
        "were trained on flows in",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_found_before_anything_is_recorded(case, tmp_path):
    pytest.importorskip("sb3_contrib")
    from tests.helpers import save_untrained

    policy = save_untrained(tmp_path / "policy.safetensors", bandwidth=3)
    (script, *words), message = REFUSED[case]
    given = [word.replace("{policy}", str(policy)) for word in words]
    folders = "--output", tmp_path / "out", "--records", tmp_path / "cache"
    assert re.search(message, refused(script, *given, *folders))
    assert list(tmp_path.iterdir()) == [policy]


FOLDERS = {
    "another plan": ("train", '{"env": "mine"}', "env is 'mine' there and 'dptse_env:"),
    "damaged": ("train", '{"env": ', "plan.json is damaged"),
    "foreign": ("train", None, "is not empty and has no plan.json: choose another --output"),
    "several": ("train", '{"env": "mine"}', "env is 'mine' there and 'dptse_env:"),
    "no plan": ("train_estimator", "[]", "plan.json is damaged: it has no plan"),
    "another estimator": ("train_estimator", '{"seed": 7}', "seed is 7 there and 0 now"),
}


@pytest.mark.parametrize("case", FOLDERS)
def test_a_folder_of_something_else_stays_as_it_is(case, tmp_path):
    pytest.importorskip("sb3_contrib")
    script, content, message = FOLDERS[case]
    folder = tmp_path / "out" / "0" if case == "several" else tmp_path / "out"
    folder.mkdir(parents=True)
    kept = folder / ("notes.txt" if content is None else "plan.json")
    kept.write_text(content or "mine")
    words = ["--seeds", "0:2"] if case == "several" else []
    if script == "train_estimator":
        words = ["--ranges.envs", SHORT]
    folders = "--output", tmp_path / "out", "--records", tmp_path / "cache"
    assert message in refused(script, *words, *folders)
    assert kept.read_text() == (content or "mine")
    assert list(folder.iterdir()) == [kept]
    assert not (tmp_path / "cache").exists()


REPLACED = {
    "evaluate": (["--env", SHORT], "rows.parquet"),
    "calibrate": ([], "fitted.json"),
    "audit": ([], "paced-worst-case-hunter.json"),
    "tune": (["--estimators", "ekf", "--parameters", "w99-3lane"], "ekf-w99-3lane-paper.json"),
    "import_network": ([], "road.toml"),
}


@pytest.mark.parametrize("script", REPLACED)
def test_results_are_not_replaced_without_force(script, tmp_path):
    words, name = REPLACED[script]
    path = tmp_path / name
    path.write_text("mine")
    output = path if script == "import_network" else tmp_path
    line = refused(script, *words, "--output", output)
    assert line == f"error: {path} would be replaced: choose another --output, or give --force"
    assert path.read_text() == "mine"


def test_a_folder_of_records_is_never_replaced(tmp_path):
    name, content, (script, *words) = FILES["trajectories"]
    (tmp_path / name).write_bytes(content)
    kept = tmp_path / "out" / "road.toml"
    kept.parent.mkdir()
    kept.write_text("mine")
    line = refused(script, *words, tmp_path / name, "--output", kept.parent)
    assert "output must be a folder that does not exist yet" in line
    assert kept.read_text() == "mine"


@pytest.mark.parametrize(
    ("problem", "status", "said"),
    [
        (ValueError("seeds must be"), 2, "error: seeds must be"),
        (FileNotFoundError(errno.ENOENT, "No such file", "a.toml"), 2,
         "error: a.toml: No such file"),
        (PermissionError(errno.EACCES, "Permission denied", "a"), 2,
         "error: a: Permission denied"),
        (OSError(errno.ENOSPC, "No space left on device", "a"), 1,
         "error: a: No space left on device"),
        (RecordingError("seed 3: SUMO"), 1, "error: seed 3: SUMO"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)  # fmt: skip
def test_the_status_says_what_happened(problem, status, said, monkeypatch):
    def collect():
        raise problem

    monkeypatch.setattr(info, "collect", collect)
    assert run_script("info") == (status, "", f"{said}\n")


def test_a_mistake_of_the_program_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr(info, "collect", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_script("info")


def test_the_page_of_commands_has_them_all():
    text = Path(ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    for name in dptse.COMMANDS:
        assert f"| `{name}` |" in text
