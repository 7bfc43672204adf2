"""Import of measured fields."""

import dataclasses
import itertools
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from dptse_env.importers.fields import UNITS, FieldRoad, FieldSource, import_field
from dptse_env.importers.folder import Split
from dptse_env.traffic import RecordLibrary, read_corridor

SPLITS = [
    Split("training", 0.5, TRAINING_SEEDS),
    Split("validation", 0.25, VALIDATION_SEEDS),
    Split("test", 0.25, TEST_SEEDS),
]
ROAD = FieldRoad(segments=3, lanes=4, speed_limit=110.0)


def save(folder, delimiter=" ", **tables):
    """Write tables, and return the field of them."""
    for name, table in tables.items():
        np.savetxt(folder / f"{name}.txt", table, delimiter=delimiter, fmt="%.17g")
    paths = {name: folder / f"{name}.txt" for name in tables}
    return FieldSource(**paths, cell=0.1, interval=5.0, delimiter=delimiter.strip() or None)


def write(folder, **changes):
    """A field in veh/ft and ft/s that grows along the road and over time."""
    along, times = np.arange(10.0)[:, None], np.arange(90.0)[None]
    density = 0.01 * (1.0 + 0.1 * along + 0.01 * times)
    speed = 60.0 * (1.0 + 0.02 * along + 0.0 * times)
    source = save(folder, density=density, speed=speed, flow=density * speed)
    units = {"cell": 0.05, "density_unit": "veh/ft", "speed_unit": "ft/s", "flow": None}
    return dataclasses.replace(source, **units | changes)


def test_a_field_becomes_a_road_with_records_of_its_own(tmp_path):
    corridor, seeds = import_field(write(tmp_path), ROAD, tmp_path / "road", SPLITS, 100)
    assert seeds == {"training": (0, 1), "validation": (1000,), "test": (2000,)}
    assert read_corridor(str(tmp_path / "road" / "road.toml")) == corridor
    assert corridor.geometry.segment_length == pytest.approx(0.1)
    assert corridor.scales.density_scale == 444.0
    assert corridor.measured == ("demand", "average_dwell")
    library = RecordLibrary(tmp_path / "cache")
    first, second = (library.get(corridor, seed) for seed in (0, 1))
    assert first.field.shape == (101, 5, 2)
    densities = [record.field[..., 0] for record in (first, second)]
    # The first window's last second comes just before the second window's first.
    step = densities[1][0] - densities[0][-1]
    np.testing.assert_allclose(step, densities[1][1] - densities[1][0], rtol=1e-6)
    # Boundary segments come last: the upstream one is the thinnest, the downstream one fullest.
    assert np.argmin(densities[0][50]) == 3
    assert np.argmax(densities[0][50]) == 4
    expected = 0.01 / 0.0003048 * (1.0 + 0.1 * 2.5 + 0.01 * (50.0 / 5.0 - 0.5))
    assert densities[0][50, 0] == pytest.approx(expected, rel=1e-6)
    demand = corridor.conditions.demand.mainline[0][1]
    flows = [record.field[:, 0].prod(axis=-1) for record in (first, second)]
    assert demand == pytest.approx(np.mean(flows), rel=1e-3)


def test_tables_may_lie_the_other_way(tmp_path):
    source = write(tmp_path, transposed=True, reversed=True)
    expected = write(tmp_path).read(4, 110.0)
    for name in ("density", "speed"):
        np.savetxt(tmp_path / f"{name}.txt", np.loadtxt(tmp_path / f"{name}.txt")[::-1].T)
    np.testing.assert_array_equal(source.read(4, 110.0), expected)


def test_environments_play_a_field_and_refuse_what_needs_vehicles(tmp_path):
    import_field(write(tmp_path), ROAD, tmp_path / "road", SPLITS, 100)
    path = str(tmp_path / "road" / "road.toml")
    with pytest.warns(UserWarning, match="on another road"):
        env = gym.make("dptse_env:dptse/PaperHighway-v0", corridor=path, bandwidth=2)
    assert env.unwrapped.config.traffic_seeds == (0, 1)
    env.reset(seed=0)
    truncated, rewards = False, []
    while not truncated:
        _, reward, _, truncated, _ = env.step(env.action_space.sample())
        rewards.append(reward)
    assert len(rewards) == 100
    assert np.isfinite(rewards).all()
    for preset in ("capped", "paced"):
        with pytest.raises(ValueError, match=rf"on a road of measured fields, got '{preset}'"):
            gym.make("dptse_env:dptse/PaperHighway-v0", corridor=path, bandwidth=2, privacy=preset)
    with_loops = read_corridor(path).replaced(loops={"positions": [0.0]})
    for keywords in ({"corridor": path, "loops": with_loops.loops}, {"corridor": with_loops}):
        with pytest.raises(ValueError, match=r"^corridor\.loops must be None on a road of .*"):
            gym.make("dptse_env:dptse/PaperHighway-v0", bandwidth=2, **keywords)


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_all_windows_may_be_for_tests(tmp_path):
    shares = [each._replace(share=float(each.name == "test")) for each in SPLITS]
    road, seeds = import_field(write(tmp_path), ROAD, tmp_path / "road", shares, 100)
    assert seeds == {"training": (), "validation": (), "test": (2000, 2001, 2002, 2003)}
    fields = [RecordLibrary(tmp_path).get(road, seed).field for seed in seeds["test"]]
    flow = np.mean([field[:, 0].prod(axis=-1) for field in fields])
    assert road.conditions.demand.mainline[0][1] == pytest.approx(flow, rel=1e-3)
    env = gym.make("dptse_env:dptse/PaperHighway-v0", corridor=road, bandwidth=2)
    assert env.unwrapped.config.traffic_seeds == seeds["test"]


@pytest.mark.parametrize(
    ("changes", "road", "duration", "message"),
    [
        ({"speed": None}, {}, 100, r"speed must be given, or else flow"),
        ({"density_unit": "cars"}, {}, 100, r"density_unit must be one of veh/km, .*got 'cars'"),
        ({"cell": 0.0}, {}, 100, r"cell must be"),
        ({"delimiter": "\\t"}, {}, 100, r"delimiter must be a character, or left out .*\\\\t'"),
        ({"delimiter": ","}, {}, 100, r"density\.txt must be a table of numbers, with ',' between"),
        ({}, {}, 450, r"duration must be below the field's 450 s, got 450"),
        ({}, {"segments": 9}, 100, r"segments must be at most 8, on 10 cells of 0\.05 km"),
        ({"cell": 0.013}, {}, 100, r"density\.txt must be a table of at least 16 cells, .*got 10"),
        ({}, {"lanes": 1}, 100, r"speed\.txt: flow must be at most 4000 veh/h on 1 lanes"),
        (b"fast slow\n", {}, 100, r"speed\.txt must be a table of numbers"),
        (b"1 2\n3 4\n", {}, 100, r"speed\.txt must be a table of .*density\.txt's shape"),
        (b"1 2\n-3 4\n", {}, 100, r"speed\.txt: row 2, column 1 must be in \[0, 1e\+06\], or nan"),
        (None, {}, 100, r"speed\.txt must be a file, got a directory"),
        ("density.txt", {}, 100, r"density\.txt must be of other values than .*density\.txt"),
        ({"density_unit": None}, {}, 100, r"density\.txt: .* likely veh/ft or veh/m, got"),
        (
            {"speed": None, "flow": "flow.txt"},
            {},
            100,
            r"flow\.txt: flow_unit .* likely veh/s, got",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt:UserWarning")
def test_fields_of_no_use_are_refused_and_leave_nothing(changes, road, duration, message, tmp_path):
    source, speed = write(tmp_path), tmp_path / "speed.txt"
    if isinstance(changes, bytes):
        speed.write_bytes(changes)
    elif changes is None:
        speed.unlink()
        speed.mkdir()
    elif isinstance(changes, str):
        source = write(tmp_path, speed=tmp_path / changes)
    else:
        files = {"flow": tmp_path / "flow.txt"} if "flow" in changes else {}
        source = dataclasses.replace(source, **changes | files)
    with pytest.raises(ValueError, match=message):
        import_field(source, dataclasses.replace(ROAD, **road), tmp_path / "road", SPLITS, duration)
    assert {each.name for each in tmp_path.iterdir()} == {"density.txt", "flow.txt", "speed.txt"}


@pytest.mark.parametrize(
    ("kind", "unit", "problem"),
    [
        ("density", "veh/km", r"no density is above"),
        ("speed", "m/s", r"100 % of speeds are above 200 km/h"),
        ("flow", "veh/min", r"no speed is above"),
    ],
)
@pytest.mark.filterwarnings("ignore:no speed of the field is above")
def test_a_unit_that_is_given_is_kept_and_what_is_odd_is_told(kind, unit, problem, tmp_path):
    changes = {"speed": None, "flow": tmp_path / "flow.txt"} if kind == "flow" else {}
    source = write(tmp_path, **changes, **{f"{kind}_unit": unit})
    with pytest.warns(
        UserWarning, match=rf"{kind}\.txt: {kind}_unit, as given: {unit}; is that right.* {problem}"
    ):
        density, flow = source.read(100, 110.0)
    table = UNITS[kind][unit] * np.loadtxt(tmp_path / f"{kind}.txt")
    got = {"density": density, "flow": flow, "speed": flow / density}[kind]
    np.testing.assert_allclose(got, table)


def test_speeds_in_metres_a_second_are_told_in_light_traffic_alone(tmp_path):
    source = write(tmp_path, speed_unit=None)
    np.savetxt(tmp_path / "speed.txt", np.full((10, 90), 29.0))
    allowed = r"likely m/s or mi/h, got km/h: speeds are 29 km/h in light traffic, at a limit"
    with pytest.raises(ValueError, match=rf"speed\.txt: speed_unit must fit .*{allowed} of 110"):
        source.read(4, 110.0)
    np.savetxt(tmp_path / "density.txt", np.full((10, 90), 0.02))  # 16 veh/km a lane
    with pytest.warns(UserWarning, match=r"no speed of the field is above 29 km/h, at a limit of"):
        source.read(4, 110.0)


def test_short_gaps_are_filled_and_told_and_long_ones_refused(tmp_path):
    source = write(tmp_path)
    density, flow = source.read(4, 110.0)
    table, speeds = np.loadtxt(source.density), np.loadtxt(source.speed)
    table[2, 10:13] = table[4, 0] = np.nan
    table[7], speeds[7] = 0.0, np.nan  # nobody was there, so no speed is missing
    rows = [",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in table]
    source.density.write_text("\n".join(rows))
    np.savetxt(source.speed, speeds, delimiter=",")
    source = dataclasses.replace(source, delimiter=",", longest_gap=15.0)
    with pytest.warns(UserWarning, match=r"density\.txt: 4 of 900 values are missing") as told:
        filled, flows = source.read(4, 110.0)
    assert len(told) == 1
    expected = density.copy()
    expected[7], expected[4, 0] = 0.0, density[4, 1]
    np.testing.assert_allclose(filled, expected)
    np.testing.assert_allclose(flows[:4], flow[:4])
    assert (flows[7] == 0.0).all()
    for changes, message in (
        ({"longest_gap": 10.0, "reversed": True}, r"row 3 must .* got none from column 11 to 13"),
        ({"longest_gap": -1.0}, r"longest_gap must be"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(source, **changes).read(4, 110.0)
    table[5] = np.nan
    np.savetxt(source.density, table.T, delimiter=",")
    np.savetxt(source.speed, speeds.T, delimiter=",")
    turned = dataclasses.replace(source, transposed=True)
    with pytest.raises(ValueError, match=r"density\.txt: column 6 must have values, got none"):
        turned.read(4, 110.0)


def traffic(cells=12, intervals=60):
    """Density [veh/km] and speed [km/h] of 100 m and 5 s each: waves upstream, at 18 km/h."""
    place, time = 0.1 * np.arange(cells)[:, None], 5.0 / 3600.0 * np.arange(intervals)[None]
    rng = np.random.default_rng(0)
    waves = sum(np.sin(400.0 * u * (time + place / 18.0) + 7.0 * p) for u, p in rng.random((8, 2)))
    density = 180.0 + 12.0 * waves
    return density, 18.0 * (450.0 / density - 1.0)


def test_zeros_while_sensors_were_off_are_gaps(tmp_path):
    density, speed = traffic()
    expected = save(tmp_path, density=density, speed=speed).read(3, 100.0)[0]
    density[:, 20:23] = speed[:, 20:23] = 0.0  # all
    with pytest.warns(UserWarning, match=r"in column\(s\) 21\.\.23, sensors were off: 36 zeros"):
        found, flow = save(tmp_path, density=density, speed=speed).read(3, 100.0)
    np.testing.assert_allclose(
        np.delete(found, slice(20, 23), 1), np.delete(expected, slice(20, 23), 1)
    )
    assert found.min() > 50.0
    assert flow.min() > 500.0
    density[4, 30:50] = speed[4, 30:50] = 0.0  # one, for 100 s
    with pytest.raises(ValueError, match=r"row 5 must .* got none from column 31 to 50 but zeros"):
        save(tmp_path, density=density, speed=speed).read(3, 100.0)
    density[4] = speed[4] = 0.0
    with pytest.raises(ValueError, match=r"density\.txt: row 5 must .*, got none but zeros"):
        save(tmp_path, density=density, speed=speed).read(3, 100.0)


@pytest.mark.parametrize("kind", ["speed", "flow"])
@pytest.mark.parametrize("cells", [slice(3), slice(-3, None), slice(1, 12, 2), slice(1, 12)])
def test_sensors_that_are_off_beside_others_are_gaps(cells, kind, tmp_path):
    density, speed = traffic()
    tables = {"density": density, kind: speed if kind == "speed" else density * speed}
    for zero in ("density", kind):  # density alone at first: the other one contradicts it
        tables["density"][cells, 20:32] = tables[zero][cells, 20:32] = 0.0  # 60 s
        told = f"sensors were off: {density[cells, 20:32].size} zeros"
        with pytest.warns(UserWarning, match=rf"in column\(s\) 21\.\.32, {told}"):
            found, flow = save(tmp_path, **tables).read(3, 100.0)
        assert found.min() > 50.0
        assert flow.min() > 500.0


@pytest.mark.parametrize(
    ("kind", "place", "number", "message"),
    [
        ("density", np.s_[3, 7], 9999, r"density\.txt: row 4, column 8 must be .*, got 9999$"),
        ("speed", np.s_[3, 7], 999, r"speed\.txt: row 4, column 8 must be .*, got 999$"),
        ("speed", np.s_[3:6, 7], 255, r"3 values are 255 km/h, .*: let them be nan if"),
        ("speed", np.s_[4, 30:42], 0, r"column\(s\) 31\.\.42, .*speed\.txt is 0 where vehicles"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_numbers_that_no_road_can_have_are_refused_and_doubtful_ones_told(
    kind, place, number, message, tmp_path
):
    tables = dict(zip(("density", "speed"), traffic(), strict=True))
    tables[kind][place] = number
    with pytest.raises((ValueError, UserWarning), match=message):
        save(tmp_path, **tables).read(3, 100.0)


def test_a_ramp_may_feed_a_road_that_is_empty_upstream(tmp_path):
    density, speed = traffic()
    density[:4, 20:50] = speed[:4, 20:50] = 0.0
    density[4:, 20:50], speed[4:, 20:50] = 15.0, 60.0  # 37 vehicles
    found = save(tmp_path, density=density, speed=speed).read(3, 100.0)[0]
    np.testing.assert_allclose(found, density, rtol=1e-5)


@pytest.mark.parametrize(
    ("empty", "told"), [(np.nan, []), (100.0, [r"in column(s) 1..15, 21..50, the road is empty"])]
)
def test_a_road_may_be_empty_for_minutes(empty, told, tmp_path):
    density, speed = traffic()
    density[:, 20:50], speed[:, 20:50] = 0.0, empty
    density[:6, :15] = speed[:6, :15] = 0.0  # before the first vehicles arrive
    density[6:, :15], speed[6:, :15] = 0.0, empty
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found, flow = save(tmp_path, density=density, speed=speed).read(3, 100.0)
    assert all(words in str(each.message) for words, each in zip(told, caught, strict=True))
    np.testing.assert_allclose(found, density, rtol=1e-5)
    assert not flow[:, 20:50].any()


@pytest.mark.parametrize(
    ("rows", "columns", "got"),
    [
        (True, False, r"row 1 must be values, got a header or an index, 1, 2, 3"),
        (False, True, r"column 1 must be values, got a header or an index, 12\.01, 12\.04, 12\.09"),
        (True, True, r"row 1 must be values"),
    ],
)
def test_headers_and_index_columns_are_named(rows, columns, got, tmp_path):
    tables = {}
    for name, values in zip(("density", "speed"), traffic(), strict=True):
        header, index = np.arange(60.0), 12.0 + 0.01 * np.arange(12.0)[:, None] ** 2
        table = np.hstack([index, values]) if columns else values
        header = np.concatenate([[np.nan], header]) if columns else header
        tables[name] = np.vstack([header, table]) if rows else table
    with pytest.raises(
        ValueError, match=rf"density\.txt: {got}.*, \.\.\., as in .*speed\.txt: leave it out"
    ):
        save(tmp_path, ",", **tables).read(3, 100.0)


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("backward", [False, True])
def test_rows_and_cells_in_another_order_are_told(transposed, backward, tmp_path):
    tables = dict(zip(("density", "speed"), traffic(), strict=True))
    tables = {name: table[::-1] if backward else table for name, table in tables.items()}
    tables = {name: table.T if transposed else table for name, table in tables.items()}
    source = save(tmp_path, **tables)
    for turns in itertools.product((False, True), repeat=2):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            dataclasses.replace(source, transposed=turns[0], reversed=turns[1]).read(3, 100.0)
        words = " ".join(str(each.message) for each in told)
        assert ("transposed" in words) == (turns[0] != transposed)
        assert ("reversed" in words) == (turns == (transposed, not backward))


@pytest.mark.parametrize("interval", [60.0, 300.0])
def test_a_field_may_have_long_intervals(interval, tmp_path):
    """Longer than what is looked at to tell its order."""
    density, _ = write(tmp_path, interval=interval).read(4, 110.0)
    assert density.shape == (10, 90)


def test_a_folder_is_never_replaced(tmp_path):
    with pytest.raises(ValueError, match=r"output must be a folder with a name, got '\.'"):
        import_field(write(tmp_path), ROAD, Path(), SPLITS, 100)
    import_field(write(tmp_path), ROAD, tmp_path / "road", SPLITS, 100)
    with pytest.raises(ValueError, match=r"output must not exist yet"):
        import_field(write(tmp_path), ROAD, tmp_path / "road", SPLITS, 100)
