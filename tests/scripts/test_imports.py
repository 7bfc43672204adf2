"""Import of trajectories, of a field and of a network by the command."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from dptse_env.traffic import Demand, RecordLibrary, read_corridor
from scripts.evaluate import not_published
from tests.helpers import ROOT, make_env
from tests.importers.data import driven, plain, stream, write_csv
from tests.importers.sumo_net.conftest import PATH, motorway
from tests.importers.test_fields import write
from tests.importers.test_tables import FOOT, ngsim
from tests.scripts.commands import refused, run_command

PAPER = "dptse_env:dptse/PaperHighway-v0"
ROAD = """n_mainline = 4
duration = 20
speed_limit = 100
demand = { mainline = [[0, 1]] }
environment = { bandwidth = 2 }
"""


def run(*words):
    done = run_command("import", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def on(road):
    return f'{PAPER} {{"corridor": "{road}"}}'


@pytest.fixture
def road(tmp_path):
    (tmp_path / "road.toml").write_text(ROAD)
    return tmp_path / "road.toml"


def test_trajectories_become_a_road_that_the_other_commands_take(road, tmp_path):
    path = plain(tmp_path / "a.csv", stream(seconds=125.0))
    columns = "time=t", "vehicle=id", "x=s", "speed=v"
    words = "trajectories", "--files", path, "--env", on(road), "--output", tmp_path / "new"
    printed = run(*words, "--format", "table", "--columns", *columns)
    assert "training: 4 window(s), traffic seeds 0..3" in printed
    assert "test: 1 window(s), traffic seeds 2000" in printed
    new = tmp_path / "new" / "road.toml"
    assert {each.name for each in new.parent.iterdir()} == {
        "manifest.json", "records", "report.json", "report.md", "report.png", "road.toml"
    }  # fmt: skip
    # What the road file says of an environment stays.
    assert re.search(r"\[environment\]\s+bandwidth = 2", new.read_text())
    assert "T_avg" in run_command("record", "--env", on(new), "--train-seeds", "0:4").stdout
    assert "seed" in refused("record", "--env", on(new), "--train-seeds", "0:16")
    assert "Not to be published" in not_published(read_corridor(new).recordings)
    # A folder of records is never replaced.
    assert "output" in refused("import", *words, "--format", "table", "--columns", *columns)
    assert new.is_file()


@pytest.fixture(scope="module")
def fifteen_minutes(tmp_path_factory):
    """A folder with the files of the page on data, and 15 minutes of simulated NGSIM rows."""
    folder = tmp_path_factory.mktemp("page")
    page = (ROOT / "docs" / "guides" / "your-data.md").read_text(encoding="utf-8")
    for name, content in re.findall(r'```toml title="(\S+)"\n(.*?)```', page, re.DOTALL):
        (folder / name).write_text(content)
    flows = Demand(((0.0, 4000.0), (300.0, 6500.0), (600.0, 4500.0)), (400.0,))
    road = read_corridor(folder / "road.toml")
    road = road.replaced(demand=flows, duration=899)
    points, column = driven(RecordLibrary(folder / "records").get(road, 0), road)
    columns = ngsim(points + np.array([0.0, 0.0, 66.0 * FOOT, 0.0]))
    columns["Vehicle_ID"] %= 25  # some are there twice at one time, as in the portal's file
    # Six segments, on-ramp, off-ramp, the boundaries up and down the road and those of the ramps.
    columns["Lane_ID"] = np.array([1, 1, 1, 1, 1, 1, 7, 8, 1, 1, 7, 8])[column]
    write_csv(folder / "0750am-0805am.csv", columns)
    return folder


def commands_of(name):
    """Return the command lines of a page."""
    page = (ROOT / "docs" / "guides" / name).read_text(encoding="utf-8").replace("\\\n", " ")
    return [shlex.split(line)[1:] for line in re.findall(r"^dptse .*$", page, re.MULTILINE)]


def test_the_page_on_own_data_has_commands_that_run(fifteen_minutes, monkeypatch):
    monkeypatch.chdir(fifteen_minutes)
    commands = commands_of("your-data.md")
    assert [words[0] for words in commands] == [
        "import", "fit", "evaluate", "train", "evaluate", "import"
    ]  # fmt: skip
    printed = run(*commands[0][1:])
    for part, seed in (("training", 0), ("validation", 1000), ("test", 2000)):
        assert f"{part}: 1 window(s), traffic seeds {seed}\n" in printed
    assert "next: dptse fit us-101/road.toml\n" in printed
    (file,) = json.loads(Path("us-101/report.json").read_text())["files"]
    assert file["ids_shared"] > 10
    assert file["vanished"] < 0.02 * file["pieces"]
    assert re.search(
        r"^next: dptse evaluate .*us-101/road.toml.* --test-seeds 2000:2001$", printed, re.M
    )


def test_the_page_on_own_data_imports_a_field(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    waves = 30.0 + 10.0 * np.sin(np.add.outer(np.arange(40), np.arange(200)) / 5.0)
    np.savetxt("density.txt", waves)
    np.savetxt("speed.txt", 110.0 - waves)
    printed = run(*commands_of("your-data.md")[-1][1:])
    assert "training: 1 window(s), traffic seeds 0\n" in printed
    road = read_corridor("ring-road/road.toml")
    assert (road.name, road.geometry.n_mainline) == ("ring-road", 6)
    assert not_published(road.recordings) == not_published(None) == ""


@pytest.mark.parametrize(
    ("more", "missing", "next_ones"),
    [
        (("--duration", "300"), "validation and test", []),
        (("--duration", "140", "--shares", "0", "0", "1"), "training and validation", ["evaluate"]),
    ],
)
def test_a_field_says_what_is_missing_for_what_comes_next(more, missing, next_ones, tmp_path):
    field = write(tmp_path)
    printed = run(
        "field", "--density", field.density, "--speed", field.speed, "--cell", "0.05",
        "--interval", "5", "--density-unit", "veh/ft", "--speed-unit", "ft/s",
        "--segments", "3", "--lanes", "5", "--speed-limit", "110", *more,
        "--output", tmp_path / "new",
    )  # fmt: skip
    assert f"note: there is no window for {missing}" in printed
    lines = [shlex.split(line) for line in re.findall(r"^next: dptse (.*)$", printed, re.MULTILINE)]
    assert [words[0] for words in lines] == next_ones
    assert all(words[-1] == "2000:2003" for words in lines)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    motorway(folder)
    (folder / "own.sumocfg").write_text(
        '<configuration><net-file value="road.net.xml"/><route-files value="road.rou.xml"/>'
        '<step-length value="0.5"/></configuration>'
    )
    return folder


def test_a_network_becomes_a_road_of_any_environment(town):
    named, given = town / "My own" / "road.toml", town / "given" / "road.toml"
    words = "network", "--duration", "120", "--output"
    own = "--configuration", town / "own.sumocfg", "--path", "in ... out"
    printed = run(*words, named.parent, *own)
    assert "on-ramp at face 3: ramp-b" in printed
    assert "off-ramp at face 15: exit-a" in printed
    assert f"next: dptse fit {shlex.quote(named.as_posix())}\n" in printed
    files = "--net", town / "road.net.xml", "--routes", town / "road.rou.xml"
    more = "--path", " ".join(PATH), "--step-length", "0.5", "--quiet"
    assert run(*words, given.parent, *files, *more) == ""
    assert read_corridor(given).digest == read_corridor(named).digest
    assert (read_corridor(given).name, read_corridor(named).name) == ("given", "my-own")
    assert f"got {named}" in refused("import", *words, named.parent, *own)
    found = json.loads(run(*words, named.parent, *own, "--force", "--json"))
    assert found["road"] == str(named)
    assert [line.split()[1] for line in found["next"]] == ["fit", "evaluate"]
    assert any("fixed_sensors = " in note for note in found["notes"])
    with pytest.warns(UserWarning, match="values measured or tuned on"):
        env = make_env(
            corridor=str(named), estimator="random_walk", traffic_seeds="0:1",
            records=str(town / "records"),
        )  # fmt: skip
    env.reset(seed=0)
    for _ in range(60):
        *_, info = env.step(env.action_space.sample())
    assert info["n_occupied"] > 5
