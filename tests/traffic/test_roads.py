"""Roads by name and as TOML files."""

import sys

import gymnasium as gym
import pytest

from dptse_env.config import resolve
from dptse_env.registration import REGISTRIES
from dptse_env.traffic import (
    CORRIDORS,
    PAPER_HIGHWAY,
    Demand,
    DemandDistribution,
    randomised,
    read_corridor,
    read_road,
    write_corridor,
)
from dptse_env.traffic.roads import PARTS

ROAD = """
n_mainline = 8
lanes = 2
segment_length = 0.2
speed_limit = 90
duration = 300
on_ramps = [3]

[demand]
mainline = [[0, 1800], [100, 3000]]
on_ramps = [300]

[drivers]
model = "IDM"

[environment]
bandwidth = 3
parameters = "arz.json"
"""


@pytest.fixture
def road(tmp_path):
    path = tmp_path / "My road.toml"
    path.write_text(ROAD)
    return path


def test_a_corridor_survives_a_file(road, tmp_path):
    text = ROAD.replace("on_ramps = [300]", "on_ramps = [[[0, 100], [60, 900]]]")
    several = """
[[incident]]
segment = 2
phases = [[50, 90, 20]]

[[incident]]
segments = [4, 5]
start = [100, 120]
"""
    road.write_text(text + several)
    corridor = read_corridor(road)
    assert corridor.conditions.demand.ramp_profiles == (((0.0, 100.0), (60.0, 900.0)),)
    kinds = [type(each).__name__ for each in corridor.conditions.incidents]
    assert kinds == ["Incident", "IncidentDistribution"]
    for each in (corridor, randomised(PAPER_HIGHWAY)):
        write_corridor(tmp_path / "road.toml", each, comment="a road\nin two lines")
        assert read_corridor(tmp_path / "road.toml") == each
        assert read_corridor(str(tmp_path / "road.toml")).digest == each.digest


def test_a_road_file_has_an_array_in_few_lines(tmp_path):
    path, rates = tmp_path / "road.toml", tuple((30.0 * k, 1000.0 + k) for k in range(40))
    road = PAPER_HIGHWAY.replaced(
        demand=Demand(rates, (100.0,) * len(PAPER_HIGHWAY.geometry.on_ramps))
    )
    write_corridor(path, road, {"query_spans": [1, 2]}, "a comment")
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) < 60
    assert 80 < max(map(len, lines)) <= 100
    assert "query_spans = [1, 2]" in lines
    assert read_corridor(path) == road


def test_what_a_file_leaves_out_is_derived_from_the_road(road):
    read = read_road(road)
    corridor = read.corridor
    assert corridor.name == "my-road"
    assert corridor.conditions.drivers.model == "IDM"
    assert corridor.conditions.incident is None
    assert corridor.fixed_sensors == ()
    assert corridor.scales.density_scale == 222.0
    assert corridor.scales.speed_scale == 90.0
    assert corridor.scales.average_dwell == pytest.approx(3 * 3600 * 0.2 / 90)
    assert read.assumed == ("average_dwell",)


KEYWORD = "bandwidth = 3"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lanes = 2", "lane = 2", r"corridor\.lane is unknown; allowed: name"),
        ("n_mainline = 8", "", r"corridor\.n_mainline is missing"),
        ("1800", "9" * 5000, r"a road file must be TOML: Exceeds the limit"),
        ("1800", '"many"', r"corridor\.demand\.mainline\[0\]\[1\]"),
        ("lanes = 2", "lanes = 2\nlanes = 3", r"a road file must be TOML: .*line 4"),
        ("[environment]", "[[environment]]", r"environment must be a table"),
        (KEYWORD, 'corridor = "x"', r"environment\.corridor must be left out"),
        (KEYWORD, "incident" + ".a" * 5000 + " = 1", r"environment must not be nested so"),
        (KEYWORD, "bandwidth = 0", r"environment\.bandwidth must be"),
        (KEYWORD, 'estimator = "best"', r"environment\.estimator must be .*, got 'best'"),
        (KEYWORD, "epsilon = 0", r"environment\.privacy\.epsilon must be"),
        (KEYWORD, 'incident = "some"', r"environment\.corridor\.incident must be one of"),
        (KEYWORD, '"a\\nb" = 0', r"environment\.a\\nb is unknown"),
        (KEYWORD, 'estimator_settings = "x.json"', r"environment\.estimator_settings: .*cannot be"),
        (KEYWORD, "bandwidth = 9", r"environment\.bandwidth must be in 1\.\.8, got 9"),
        (
            KEYWORD,
            'estimator = "recurrent"\nestimator_settings = { recurrent = { weights = "x" } }',
            r"environment\.estimator_settings\.recurrent\.weights must be a file or .*, got 'x'",
        ),
    ],
)
def test_bad_files_are_refused_by_file_and_key(road, old, new, message):
    text = ROAD.replace('"arz.json"', '"w99-3lane"')
    road.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=rf"^.*My road\.toml: {message}"):
        resolve("private-highway", {"corridor": str(road)})


@pytest.mark.parametrize(
    ("keyword", "value", "path"),
    [
        ("action", '"own:Part"', ""),
        ("estimator", '"own:Part"', ""),
        ("observation", '["default", "own:Part"]', r"\[1\]"),
        ("privacy", '{ preset = "own:Part" }', r"\.preset"),
        ("reward", '"own:Part"', ""),
    ],
)
def test_a_file_imports_no_code(road, keyword, value, path, monkeypatch):
    assert {*REGISTRIES} - {"corridor", "schedule"} == {*PARTS}  # each of them is here
    trace = road.parent / "trace"
    (road.parent / "own.py").write_text(f"import os\nos.mkdir({str(trace)!r})\nPart = None")
    monkeypatch.chdir(road.parent)
    monkeypatch.syspath_prepend("")
    monkeypatch.delitem(sys.modules, "own", raising=False)
    road.write_text(ROAD.replace("bandwidth = 3", f"{keyword} = {value}"))
    allowed = r"a registered name \(import strings come from Python or the command line alone\)"
    message = rf"My road\.toml: environment\.{keyword}{path} must be {allowed}, got 'own:Part'$"
    with pytest.raises(ValueError, match=message):
        gym.make("dptse_env:dptse/PrivateHighway-v1", corridor=str(road))
    assert not trace.exists()
    with pytest.raises(ValueError, match=r"^estimator must be a subclass of .*, got None$"):
        gym.make("dptse_env:dptse/PrivateHighway-v1", estimator="own:Part")  # as Python may
    assert trace.exists()


def test_files_that_cannot_be_read(tmp_path):
    path = tmp_path / "road.toml"
    for content in (b"\xff\xfe\x00", b"a = " + b"[" * 100_000):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"road\.toml: a road file must be TOML"):
            read_road(path)
    for missing in (path.with_name("none.toml"), tmp_path):
        with pytest.raises(ValueError, match=rf"{missing.name}: the road file cannot be read"):
            read_road(missing)


def test_the_keywords_of_a_file_come_after_the_callers(road):
    road.write_text(ROAD.replace('"arz.json"', '"w99-3lane"'))
    with pytest.warns(UserWarning, match=r"corridor\.average_dwell"):
        config = resolve("private-highway", {"corridor": str(road)})
    assert config.bandwidth == 3
    assert config.parameters.name == "w99-3lane"
    assert "parameters" not in config.inherited
    assert "corridor.average_dwell" in config.inherited
    with pytest.warns(UserWarning, match=r"corridor\.average_dwell"):
        config = resolve("private-highway", {"corridor": str(road), "bandwidth": 1})
    assert config.bandwidth == 1


@pytest.mark.parametrize("corridor", CORRIDORS.values(), ids=CORRIDORS)
def test_randomised_traffic_keeps_the_road_and_the_base_demand(corridor):
    random = randomised(corridor)
    assert random.conditions.demand == DemandDistribution(corridor.conditions.published_demand)
    assert random.digest != corridor.digest
    assert random.geometry.on_ramps == corridor.geometry.on_ramps
    assert randomised(random) == random
    last_start = random.conditions.incident.start[1]
    assert last_start + random.conditions.incident.duration[0] < corridor.conditions.duration


@pytest.mark.parametrize("name", ["ekf.json", "weights/mine-flows.safetensors"])
def test_names_of_files_are_those_of_the_folder_of_the_road_file(road, name):
    text = f'estimator_settings = {{ recurrent = {{ weights = "{name}" }} }}\n'
    road.write_text(ROAD + text)
    found = read_road(road).environment["estimator_settings"]
    assert found == {"recurrent": {"weights": str(road.parent / name)}}
