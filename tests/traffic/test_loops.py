"""Settings of loops: borders, warnings, refusals and road files."""

import math

import pytest

from dptse_env.config import resolve
from dptse_env.traffic import SHORT_HIGHWAY, Loops, read_corridor, write_corridor
from dptse_env.traffic.loops import Stations

PLACES = {"positions": [0.0, 0.3, 0.6]}


def test_a_position_within_a_segment_is_moved_to_the_nearest_border_and_this_is_said():
    said = r"corridor\.loops\.positions lie within segments; moved 0\.16 to 0\.2 km"
    with pytest.warns(UserWarning, match=said):
        road = SHORT_HIGHWAY.replaced(loops={"positions": [0.0, 0.16, 0.3004]})
    assert road.loops == Loops((0.0, 0.2, 0.3))


@pytest.mark.parametrize(
    ("loops", "message"),
    [
        ({"positions": [0.61]}, r"positions must be .*, got 0\.61"),
        ({"positions": [-0.1]}, r"positions\[0\] must be .*, got -0\.1"),
        ({"positions": [math.nan]}, r"positions\[0\] must be .*, got nan"),
        ({"positions": 0.3}, r"positions must be .*, got 0\.3"),
        ({"positions": [0.3, 0.3]}, r"positions must be increasing, got \(0\.3, 0\.3\)"),
        ({"positions": [0.29, 0.31]}, r"positions must be nearest to .*"),
        ({}, r"positions must be .*, got \(\)"),
        (PLACES | {"interval": 9}, r"interval must be .* 10\.\.600, got 9"),
        (PLACES | {"interval": 601}, r"interval must be .*, got 601"),
        (PLACES | {"interval": 300}, r"interval must be <= 240 s, .*, got 300"),
        (PLACES | {"least_count": -1}, r"least_count must be .*, got -1"),
        (PLACES | {"ramps": [3]}, r"ramps must be .*, got 3"),
        (PLACES | {"ramps": [4, 2]}, r"ramps must be increasing, got \(4, 2\)"),
        (PLACES | {"lanes": 3}, r"lanes is unknown; allowed: .*"),
    ],
)
def test_what_is_no_station_is_refused_with_path_and_value(loops, message):
    with pytest.raises(ValueError, match=rf"^corridor\.loops\.{message}$"):
        resolve("short-plain", {"loops": loops})


def test_loops_need_queries_of_single_segments():
    with pytest.raises(ValueError, match=r"^query_spans must be "):
        resolve("short-plain", {"loops": PLACES, "query_spans": [2]})


def test_a_road_file_keeps_loops_and_names_itself_where_they_are_wrong(tmp_path):
    path = tmp_path / "road.toml"
    loops = PLACES | {"ramps": [2], "interval": 30, "least_count": 2}
    road = SHORT_HIGHWAY.replaced(name="own", loops=loops)
    write_corridor(path, road)
    assert read_corridor(path) == road
    given = {"corridor": str(path), "loops": {"interval": 60}}
    assert resolve("short-plain", given).corridor.loops.interval == 60
    assert resolve("short-plain", {"corridor": str(path), "loops": None}).corridor.loops is None
    path.write_text(path.read_text().replace("interval = 30", "interval = 700"))
    with pytest.raises(ValueError, match=r"road\.toml: corridor\.loops\.interval must be .* 700"):
        read_corridor(path)


def test_stations_at_the_ends_name_the_segment_where_vehicles_come_or_leave():
    geometry = SHORT_HIGHWAY.geometry
    stations = Stations.of(Loops((0.0, 0.3, 0.6), ramps=(2,)), geometry)
    assert stations.enters.tolist() == [0, -1, -1, -1]
    assert stations.leaves.tolist() == [-1, -1, 5, -1]
    assert stations.positions.tolist() == [0.0, 0.3, 0.6, 0.2]
    assert stations.beside.tolist() == [[0, 0], [2, 3], [5, 5], [6, 6]]
    assert Stations.of(None, geometry).upstream.shape == (0, geometry.n_cells)
