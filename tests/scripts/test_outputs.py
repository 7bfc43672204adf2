"""Every command that writes results checks their place before any work."""

import errno
import re

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("tyro")

from agents import models
from dptse_env.importers import folder
from dptse_env.importers.fields import FieldSource
from dptse_env.traffic import library
from dptse_env.utils import files
from scripts import imports
from scripts.dptse import MODULES
from tests.helpers import SHORT, fast_and_slow
from tests.importers.data import plain, stream
from tests.importers.sumo_net.conftest import motorway
from tests.scripts.commands import ROAD, refused, run_command
from tests.scripts.test_imports import on
from tests.scripts.test_train_estimator import SMALL

TABLE = "\n".join(" ".join(["30"] * 60) for _ in range(16))
ONE = ["--workers", "1"]
COMMANDS = {
    "evaluate": (["--env", SHORT, *ONE], "tables.md"),
    "train": (["--env", SHORT, "--steps", "100", *ONE], "best.safetensors"),
    "train-estimator": (SMALL, "weights-flows.safetensors"),
    "fit --tune": (
        ["--env", SHORT, "--estimators", "random_walk"], "random_walk-published-printed.json",
    ),
    "evaluate --suite short-printed": (["--policies", "speed-front", *ONE], "card.json"),
    "study": (["examples.my_study:STUDY", *ONE], "tables.md"),
    "fit": (["road.toml", *ONE], "fit.md"),
    "audit": (["--env", SHORT, *ONE], "audit.json"),
    "record": (["--env", SHORT, "--train-seeds", "0"], None),
    "import trajectories": (
        ["--files", "points.csv", "--format", "table", "--env", on("road.toml"), "--columns",
         "time=t", "vehicle=id", "x=s", "speed=v"], "",
    ),
    "import field": (
        ["--density", "table.txt", "--speed", "table.txt", "--cell", "0.1", "--interval", "5",
         "--segments", "6", "--lanes", "3", "--speed-limit", "100"], "",
    ),
    "import network": (["--net", "road.net.xml", "--path", "a b"], "road.toml"),
    "import policy": (["model.zip", "--env", SHORT, "--trust"], "policy.safetensors"),
}  # fmt: skip
"""Arguments of each command, and what it must not replace: a file in its output, or the output
itself, of some ending."""

FAST = ("evaluate", "train", "fit", "audit", "record", "import policy")


class BegunError(Exception):
    """The work that takes time was begun."""


def begin(*_, **__):
    raise BegunError


def refuse(**_):
    raise PermissionError(errno.EACCES, "Permission denied")


def test_every_command_with_an_output_is_here():
    assert {name.split()[0] for name in COMMANDS} == {*MODULES} - {"info"}


@pytest.mark.parametrize("name", fast_and_slow(COMMANDS, FAST))
def test_a_place_where_results_cannot_go_is_refused_before_any_work(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DPTSE_CACHE", str(tmp_path / "cache"))
    for where, work in (
        (library, "record_seeds"), (models, "_unpickled"), (imports, "segment_path"),
        (folder, "Recording"), (FieldSource, "read"),
    ):  # fmt: skip
        monkeypatch.setattr(where, work, begin)
    plain(tmp_path / "points.csv", stream())
    (tmp_path / "road.toml").write_text(ROAD)
    (tmp_path / "table.txt").write_text(TABLE)
    (tmp_path / "model.zip").write_text("")
    motorway(tmp_path)
    (tmp_path / "file").write_text("mine")
    words, kept = COMMANDS[name]

    def given(place):
        option = "--records" if name == "record" else "--output"
        return [*name.split(), *words, option, place]

    here = sorted(tmp_path.iterdir())
    assert "file" in refused(*given("file/below"))
    assert "file" in refused(*given("file"))
    for start in ("", "new/"):
        long = f"{start}{(230 if kept == '' else 300) * 'a'}"  # the hidden one is longer
        assert re.search(rf" got {long}\S*: File name too long$", refused(*given(long)))
    with monkeypatch.context() as patch:
        patch.setattr(files.tempfile, "TemporaryFile", refuse)  # a mode binds no root
        assert "must be a folder that can be written" in refused(*given("new"))
    assert sorted(tmp_path.iterdir()) == here
    if kept is not None:
        taken = tmp_path / "taken"
        mine = taken / kept
        mine.mkdir(parents=True)
        offered = run_command(*name.split(), "-h").stdout
        takes_force = "--force" in offered and name not in ("fit", "evaluate --suite short-printed")
        force = ["--force"] if takes_force else []
        assert str(mine) in refused(*given(taken), *force)  # which removes no folder
        mine.rmdir()
        mine.write_text("mine")
        assert str(mine) in refused(*given(taken))
        assert mine.read_text() == "mine"
    with pytest.raises(BegunError):  # what was refused is the place alone
        run_command(*given("new/below"))
