"""Import of trajectories, of a field and of a network, by the command."""

import re
import shlex

import pytest

from dptse_env.traffic import RecordLibrary, read_corridor
from tests.helpers import make_env
from tests.importers.data import STRAIGHT, plain, stream, write_csv
from tests.importers.network.conftest import PATH, motorway
from tests.importers.test_tables import ngsim
from tests.scripts.commands import ROOT, refused, run_command

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
    assert "T_avg" in run_command("record", "--env", on(new), "--seeds", "0:4").stdout
    assert "seed" in refused("record", "--env", on(new), "--seeds", "0:16")
    # A folder of records is never replaced.
    assert "output" in refused("import", *words, "--format", "table", "--columns", *columns)
    assert new.is_file()


def test_a_mapping_describes_the_data(road, tmp_path):
    (tmp_path / "data.toml").write_text(
        'format = "ngsim"\n[where]\nLocation = "us-101"\n[layout.mainline]\nlanes = [1, 2, 3]\n'
    )
    columns = ngsim(stream())
    columns["Location"] = ["us-101"] * len(columns["Vehicle_ID"])
    path = write_csv(tmp_path / "a.csv", columns)
    run(
        "trajectories", "--files", path, "--env", on(road), "--output", tmp_path / "new",
        "--mapping", tmp_path / "data.toml", "--shares", "1", "0", "0",
    )  # fmt: skip
    assert read_corridor(tmp_path / "new" / "road.toml").n_mainline == 4
    assert (
        RecordLibrary().get(read_corridor(tmp_path / "new" / "road.toml"), 4).n_steps
        == STRAIGHT.duration + 1
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "format must be given where no mapping is"),
        (("--format", "xls"), "source.format must be one of"),
        (("--format", "table", "--columns", "t"), "columns must be key=value, got 't'"),
        (("--format", "table", "--units", "length=yd"), "source.units.length must be one of"),
        (("--format", "table", "--shares", "1", "1", "0"), "shares must be at least 0"),
    ],
)
def test_what_is_wrong_with_trajectories_is_said(words, message, road, tmp_path):
    path = plain(tmp_path / "a.csv", stream(seconds=30.0))
    common = "--files", path, "--env", on(road), "--output", tmp_path / "new"
    assert refused("import", "trajectories", *common, *words).startswith(f"error: {message}")
    assert not (tmp_path / "new").exists()


def test_the_page_on_own_data_has_commands_that_run(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "own_data.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for name, content in re.findall(r"```toml\n# (\S+)\n(.*?)```", page, re.DOTALL):
        (tmp_path / name).write_text(content)
    points = stream(seconds=723.0, headway=8.0, length=640.0)
    for name in ("0750", "0805", "0820"):
        write_csv(tmp_path / f"{name}.csv", ngsim(points))
    command = re.search(r"^dptse import (trajectories .*)$", page, re.MULTILINE)[1]
    printed = run(*shlex.split(command))
    # The page goes on with these seeds.
    assert "training: 5 window(s), traffic seeds 0..4" in printed
    assert "validation: 2 window(s), traffic seeds 1000..1001" in printed


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
    named, given = town / "My own.toml", town / "given.toml"
    words = "network", "--duration", "120", "--output"
    printed = run(*words, named, "--configuration", town / "own.sumocfg", "--path", "in ... out")
    assert "on-ramp at face 3: ramp-b" in printed
    assert "off-ramp at face 15: exit-a" in printed
    files = "--net", town / "road.net.xml", "--routes", town / "road.rou.xml"
    run(*words, given, *files, "--path", " ".join(PATH), "--step-length", "0.5")
    assert read_corridor(given).digest == read_corridor(named).digest
    assert (read_corridor(given).name, read_corridor(named).name) == ("given", "my-own")
    with pytest.warns(UserWarning, match="values measured or tuned on"):
        env = make_env(
            corridor=str(named), estimator="random_walk", traffic_seeds="0:1",
            records=str(town / "records"),
        )  # fmt: skip
    env.reset(seed=0)
    for _ in range(60):
        *_, info = env.step(env.action_space.sample())
    assert info["n_occupied"] > 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--path", "in"), "error: net must be given, or a configuration"),
        (("--net", "{town}/road.net.xml"), "error: path must be"),
        (("--net", "{town}/road.net.xml", "--path", "in ... on out"), "error: path must be"),
        (("--net", "{town}/road.net.xml", "--path", "on"), "error: path: {town}/road.net.xml"),
        (("--output", "road.json"), "error: output must be a .toml file"),
    ],
)
def test_what_is_wrong_with_a_network_is_said(words, message, town):
    given = [each.format(town=town) for each in words]
    assert refused("import", "network", *given).startswith(message.format(town=town))
