"""Points become windows of whole seconds: gaps, ids that are used again, wrong rows."""

import dataclasses
import re

import numpy as np
import polars as pl
import pytest

from dptse_env.importers import Layout, Source, Split, Strip, TrajectoryError, recording
from dptse_env.traffic import RecordLibrary
from tests.importers.data import PLAIN, ROAD, first_file, plain, run, stream, write_csv

ALL = [Split("training", 1.0, range(100_000))]


def record_of(imported, seed=0):
    return RecordLibrary().get(imported.corridor, seed)


def starts(imported):
    return [window["start"] for window in imported.report["windows"]]


def assert_alike(imported, expected, seeds=(0, 1)):
    for seed in seeds:
        one, other = record_of(imported, seed), record_of(expected, seed)
        np.testing.assert_array_equal(one.counts, other.counts)
        np.testing.assert_allclose(one.speed_sums, other.speed_sums)


def test_windows_follow_one_another_and_are_split_by_time(tmp_path):
    path = plain(tmp_path / "a.csv", stream(seconds=124.0))
    imported = run(path)
    assert imported.seeds == {"training": (0, 1, 2), "validation": (1000,), "test": (2000,)}
    assert starts(imported) == [0.0, 21.0, 42.0, 63.0, 84.0]  # 20 s and second 0: they share none
    assert [window["seed"] for window in imported.report["windows"]] == [0, 1, 2, 1000, 2000]
    (tmp_path / "imported").rename(tmp_path / "without pauses")
    # A window from second 65 on would end at 85.
    assert starts(run(path, pause=9, skip_start=5.0, skip_end=39.5)) == [5.0, 35.0]


@pytest.mark.parametrize("stray", [-1.0, 1e300])
def test_a_wrong_time_is_counted_and_left_out(stray, tmp_path):
    points = stream() + np.array([0, 1000, 0, 0])
    expected = run(plain(tmp_path / "clean" / "a.csv", points))
    wrong = points[[500]] * [1, 0, 1, 1] + np.array([0, stray, 0, 0])
    # In the place of the first row, as well as amid the file; a header is row 1.
    for row, rows in (
        (2, [*wrong, *points]),
        (902, [*points[:900], *wrong, *points[900:]]),
    ):
        path = plain(tmp_path / str(row) / "a.csv", np.array(rows))
        time = re.escape(f"{stray:.6g}")
        message = rf"a\.csv, row {row}: the time {time} s is over 600 s from all windows: 1 such"
        with pytest.warns(UserWarning, match=message):
            imported = run(path)
        assert starts(imported) == starts(expected)
        file = first_file(imported)
        assert file["far_away"] == 1
        assert file["pieces"] == first_file(expected)["pieces"]
        assert_alike(imported, expected, (0, 1, 2000))


def test_times_without_end_are_refused_before_windows_are_laid(tmp_path):
    points = stream(seconds=45.0)
    strays = np.repeat(points[:1], 20_000, axis=0)
    strays[:, 1] = 500.0 * np.arange(1, 20_001)
    path = plain(tmp_path / "a.csv", np.concatenate([points, strays]))
    message = r"a\.csv: its times must make at most 100000 windows of 21 s, got 476\d+: is the unit"
    with pytest.raises(TrajectoryError, match=message):
        run(path, splits=ALL)


def test_a_silence_of_over_ten_minutes_begins_another_recording(tmp_path):
    points = stream(seconds=45.0)
    later = points + np.array([100, 86_400, 0, 0])
    imported = run(plain(tmp_path / "a.csv", np.concatenate([points, later])), splits=ALL)
    assert starts(imported) == [0.0, 21.0, 86_400.0, 86_421.0]
    alone = run(plain(tmp_path / "alone" / "a.csv", points), splits=ALL)
    assert_alike(imported, alone)
    for seed in (0, 1):
        vehicles = record_of(imported, 2 + seed).vehicle
        assert set(vehicles) == {100 + vehicle for vehicle in record_of(alone, seed).vehicle}


jitter = np.random.default_rng(0).random


def by_time(points):
    return points[np.lexsort((points[:, 0], points[:, 1]))]


def halves(points):
    return np.concatenate([by_time(points[points[:, 1] >= 60]), by_time(points[points[:, 1] < 60])])


@pytest.mark.parametrize(
    ("back", "again", "keep", "ids"),
    [
        (0.4, 0, 1, 100),  # a correction of four frames
        (30.0, 0, 1, 100),
        (60.0, 100, 1, 100),  # another recording, whose clock begins anew
        (30.0, 0, 4, 100),  # rarely two vehicles on the road
        (18.0, 0, 1, 10),  # ids are used again, 20 s later
    ],
)
def test_a_time_that_steps_back_into_traffic_is_refused(back, again, keep, ids, tmp_path):
    points = by_time(stream())
    points[:, 0] %= ids
    points = points[points[:, 0] % keep == 0]
    late = points[:, 1] > 59.95
    row, at = 2 + late.argmax(), points[late.argmax(), 1] - back
    points[late] += [again, -back, 0, 0]
    message = rf"a\.csv, row {row}: the time must not step back .*, got {at:.10g} s after"
    with pytest.raises(TrajectoryError, match=message):
        run(plain(tmp_path / "a.csv", points))


@pytest.mark.parametrize("block", [1, 20])
def test_a_clock_that_is_set_back_is_told_in_a_file_by_vehicle(block, tmp_path):
    points = stream(seconds=200.0)
    points[points[:, 1] > 130.0, 1] -= 60.0
    blocks = np.arange(len(points)) // block
    points = points[np.lexsort((np.random.default_rng(0).random(len(points)), blocks))]
    message = r"a\.csv, row \d+: the time must not step back into .*, got 7[\d.]+ s after 1[23]\d"
    with pytest.raises(TrajectoryError, match=message):
        run(plain(tmp_path / "a.csv", points))


ORDERS = {
    "time": by_time,
    "none": lambda points: np.random.default_rng(0).permutation(points),
    "within a frame": lambda points: points[np.argsort(points[:, 1] + 0.1 * jitter(len(points)))],
    "halves": halves,
    "twice": lambda points: np.concatenate([by_time(points), by_time(points)]),
    "pages of vehicles": lambda points: np.concatenate(
        [points[300:650], np.delete(points, slice(300, 650), 0)]
    ),
}


@pytest.mark.parametrize("order", ORDERS)
def test_rows_may_be_in_any_order_of_one_traffic(order, tmp_path):
    points = stream()
    expected = run(plain(tmp_path / "a.csv", points))
    imported = run(plain(tmp_path / "b" / "a.csv", ORDERS[order](points)))
    assert first_file(imported)["steps_back"] == (order == "halves")
    assert_alike(imported, expected)


@pytest.mark.parametrize(
    ("headway", "one_id", "message"),
    [
        (0.8, True, r", row \d+: an id must be that of a vehicle, got '7' at over 20 places"),
        (4.0, False, r": an id must be .* in several rows .*, got none that is"),
    ],
)
def test_ids_that_are_all_the_same_or_all_different_are_told(headway, one_id, message, tmp_path):
    points = stream(headway=headway)
    points[:, 0] = 7 if one_id else np.arange(len(points))
    with pytest.raises(TrajectoryError, match=rf"a\.csv{message}"):
        run(plain(tmp_path / "a.csv", points))


@pytest.mark.parametrize("text", ["{}.0", " {} ", "0{}", "{}.000e+00"])
def test_codes_that_are_one_number_are_one(text, tmp_path):
    points = stream()
    counts = []
    for name, write, wanted in (("a", "{}", (1, 7)), ("b", text, (1, 7)), ("c", text, ("01", 7))):
        codes = [write.format(1 + int(vehicle) % 2) for vehicle in points[:, 0]]
        source = dataclasses.replace(
            PLAIN, columns={**PLAIN.columns, "lane": "lane", "group": "side"}, where={"site": 1},
            groups=(1,), layout=Layout(mainline=Strip(lanes=wanted)),
        )  # fmt: skip
        path = plain(tmp_path / name / "a.csv", points, lane=codes, side=codes, site=codes)
        counts.append(record_of(run(path, source)).counts)
    assert counts[0].any()
    np.testing.assert_array_equal(counts[0], counts[1])
    np.testing.assert_array_equal(counts[0], counts[2])


@pytest.mark.filterwarnings("ignore:no vehicle is on the mainline")
def test_positions_and_speeds_are_interpolated_in_time(tmp_path):
    time = 0.3 + 0.7 * np.arange(40)
    x, speed = 5.0 * time + 0.25 * time**2, 5.0 + 0.5 * time
    points = np.column_stack([np.zeros(40), time, x, speed])
    record = record_of(run(plain(tmp_path / "a.csv", points)))
    second = record.step + 1  # the first whole second is 1
    np.testing.assert_allclose(record.speed, 3.6 * (5.0 + 0.5 * second), rtol=1e-5)
    place = 5.0 * second + 0.25 * second**2 + 0.03  # a chord is 0.03 m at most above the arc
    np.testing.assert_array_equal(record.segment, place // 100.0)


def test_ramps_are_told_by_lanes_or_lateral_positions(tmp_path):
    points = stream(length=600.0)
    points[:, 2] -= 150.0
    vehicle, _, x, _ = points.T
    on, off = (vehicle % 3 == 1) & (x < 150), (vehicle % 3 == 2) & (x > 250)
    lane = np.where(on, 7, np.where(off, 8, 1))
    counts = []
    for role, parts in {
        "lane": (Strip(lanes=(7,)), Strip(lanes=(8,)), Strip(lanes=(1,))),
        "y": (Strip(lateral=(30, 37)), Strip(lateral=(37, 45)), Strip(lateral=(-3, 3))),
    }.items():
        layout = Layout(on_ramps=parts[:1], off_ramps=parts[1:2], mainline=parts[2])
        source = Source("table", {**PLAIN.columns, role: role}, layout=layout)
        path = tmp_path / role / "a.csv"
        plain(path, points, lane=lane, y=np.where(lane == 1, 0.0, 5.0 * lane))
        imported = run(path, source, ROAD)
        counts.append(record_of(imported).counts)
        assert first_file(imported)["off_lanes"] == 0
        assert imported.corridor.conditions.demand.on_ramps[0] == pytest.approx(300.0, rel=0.3)
    np.testing.assert_array_equal(*counts)
    # Vehicles of the ramp are on it to the face at 100 m, then on the mainline, as on lane 7 at
    # 100 to 150 m; those of the off-ramp likewise: two thirds of all before and behind.
    total = counts[0].sum(axis=0)[:6]  # main_0 to main_3, on_0, off_0
    np.testing.assert_allclose(total / total[2], [2 / 3, 1, 1, 2 / 3, 1 / 3, 1 / 3], atol=0.15)


def test_a_curved_road_is_straightened_by_its_centre_line(tmp_path):
    points = stream()
    angle = points[:, 2] / 1000.0  # a bend of 1 km radius, to the left
    x, y = 1000.0 * np.sin(angle), 1000.0 * (1.0 - np.cos(angle))
    line = [(1000.0 * np.sin(a), 1000.0 * (1.0 - np.cos(a))) for a in np.linspace(0, 0.5, 26)]
    columns = {**PLAIN.columns, "x": "px", "y": "py"}
    source = Source("table", columns, layout=Layout(centre_line=tuple(line)))
    straight = run(plain(tmp_path / "a.csv", points))
    assert_alike(run(plain(tmp_path / "bent" / "a.csv", points, px=x, py=y), source), straight)


def test_short_gaps_are_filled_and_longer_ones_and_jumps_cut(tmp_path):
    points = stream()
    vehicle, time = points[:, 0], points[:, 1]
    points[(vehicle == 12) & (time > 34.0), 2] -= 150.0
    filled = (vehicle == 10) & (time > 26.05) & (time < 28.05)
    cut = (vehicle == 11) & (time > 28.05) & (time < 36.05)
    imported = run(plain(tmp_path / "a.csv", points[~filled & ~cut]))
    file = first_file(imported)
    assert (file["gaps_filled"], file["seconds_filled"]) == (1, 2)
    assert (file["gaps_cut"], file["jumps_cut"]) == (1, 1)
    assert file["pieces"] == file["vehicles"] + 2
    assert file["present_at_start"] + file["entered"] + file["appeared"] == file["pieces"]
    assert file["present_at_end"] + file["left"] + file["vanished"] == file["pieces"]
    record = record_of(imported, 1)  # seconds 21 to 41
    assert (record.vehicle == 10).any()
    assert record.counts[27 - 21].sum() == record.counts[26 - 21].sum()


def test_an_id_that_is_used_again_is_another_vehicle(tmp_path):
    points = stream(headway=4.0)
    points[:, 0] %= 8  # a vehicle is there for 20 s, its id is free again after 12 s
    imported = run(plain(tmp_path / "a.csv", points))
    file = first_file(imported)
    assert (file["vehicles"], file["ids_shared"]) == (8, 0)
    assert file["pieces"] == len(np.unique(stream(headway=4.0)[:, 0]))
    record = record_of(imported, 1)
    steps = [np.sort(record.step[record.vehicle == v]) for v in np.unique(record.vehicle)]
    assert all((np.diff(each) == 1).all() for each in steps)


@pytest.mark.parametrize("shuffled", [False, True])
def test_vehicles_that_share_an_id_at_one_time_are_told_apart(shuffled, tmp_path):
    points = stream(headway=4.0)
    expected = run(plain(tmp_path / "a.csv", points))
    shared = points.copy()
    shared[:, 0] %= 4  # five are on the road at once
    shared = np.concatenate([shared, shared[300:310]])
    if shuffled:
        shared = np.random.default_rng(0).permutation(shared)
    imported = run(plain(tmp_path / "shared" / "a.csv", shared))
    file = first_file(imported)
    assert (file["vehicles"], file["ids_shared"], file["duplicates"]) == (4, 4, 10)
    assert (file["out_of_order"] > 100) == shuffled
    assert file["pieces"] == len(np.unique(points[:, 0]))
    assert_alike(imported, expected)
    record = record_of(imported, 1)
    for vehicle in np.unique(record.vehicle):
        assert (np.diff(record.segment[record.vehicle == vehicle][:-1]) >= 0).all()
    text = (tmp_path / "shared" / "imported" / "report.md").read_text("utf-8")
    assert "| 4 | ids of several vehicles at one time, told apart by their positions; " in text


def test_vehicles_that_share_an_id_may_have_times_that_alternate(tmp_path):
    points = stream(headway=8.0)
    late = points[:, 0] % 2 == 1
    points[late] += np.array([0.0, 0.05, 1.0, 0.0])  # 50 ms later, where they are then
    expected = run(plain(tmp_path / "a.csv", points))
    shared = points.copy()
    shared[:, 0] //= 2
    imported = run(plain(tmp_path / "shared" / "a.csv", shared))
    assert first_file(imported)["ids_shared"] == 8  # the last vehicle is alone
    assert_alike(imported, expected)


def test_rows_off_the_road_are_dropped_and_counted(tmp_path):
    points = stream()
    lane = np.where(points[:, 0] == 3, 9, 1)
    points[points[:, 0] == 5, 2] += 1000.0
    columns, strip = {**PLAIN.columns, "lane": "lane"}, Strip(lanes=(1,))
    source = dataclasses.replace(PLAIN, columns=columns, layout=Layout(mainline=strip))
    file = first_file(run(plain(tmp_path / "a.csv", points, lane=lane), source))
    assert file["off_lanes"] == (points[:, 0] == 3).sum()
    assert file["off_ends"] == (points[:, 0] == 5).sum()
    assert file["off_the_road"] == ["9"]
    text = (tmp_path / "imported" / "report.md").read_text("utf-8")
    assert f"| {file['off_ends']} | dropped: before the road's start or beyond its end |" in text
    assert "veh/h on the mainline, no on-ramps, no exits, average dwell" in text


UNITS = {"time": "s", "length": "m", "speed": "m/s"}


@pytest.mark.parametrize(
    ("factors", "offset", "message"),
    [
        ([1, 1, -1, 1], 400, r"layout\.reversed must be turned round"),
        ([1, 1, 1, -1], 0, r"speeds must be positive along the road, got -1 times"),
        ([1, 1, 1, np.nan], 0, r"row 2: v must be a finite number, got 'nan'"),
        ([1, 1, 1, 1], 900, r"rows must be on the road, got \d+ of \d+"),
        ([1, 0.1, 1, 1], 0, r"it must last 21 s or more, .*, got 13 s \(time in s\)"),
        ([1, 1000, 1, 1], 0, r"got 0 of \d+ that do: are the units \(time in s"),
    ],
)
def test_wrong_units_directions_and_numbers_are_refused(factors, offset, message, tmp_path):
    points = stream() * np.array(factors) + np.array([0, 0, offset, 0])
    path = plain(tmp_path / "a.csv", points)
    with pytest.raises(TrajectoryError, match=message) as refused:
        run(path, dataclasses.replace(PLAIN, units=UNITS))
    assert str(refused.value).startswith(str(path))
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]


def scaled(path, factors, speed):
    """Write a stream in other units, with times that are whole numbers where they can be."""
    vehicle, time, x, speed = (stream(speed=speed) * np.array(factors)).T
    time = [int(each) if each == round(each) else each for each in time.round(6)]
    return write_csv(path, {"t": time, "id": vehicle.astype(int), "s": x.round(6), "v": speed})


@pytest.mark.parametrize(
    ("factors", "units"),
    [
        ([1, 1000, 1, 1], "units.time = 'ms'"),
        ([1, 10, 1, 1], "units.time = 'frame' and frame_rate, the frames a second"),
        ([1, 1, 1, 3.6], "units.speed = 'km/h'"),
        ([1, 1, 1 / 0.3048, 1 / 0.3048], "units.length = 'ft', units.speed = 'ft/s'"),
        ([1, 1000, 0.001, 2.23694], "units.time = 'ms', units.length = 'km', units.speed = 'mi/h'"),
        ([1, 1, 0.01, 0.01], "none that is known"),
    ],
)
def test_units_that_cannot_be_are_refused_with_those_that_fit(factors, units, tmp_path):
    path = scaled(tmp_path / "a.csv", factors, speed=35.0 if units[0] == "u" else 20.0)
    message = re.escape(f"a.csv: units must fit the data, likely {units}, got time in s, ")
    with pytest.raises(TrajectoryError, match=rf"{message}.* by positions, at [\d.e+]+ times"):
        run(path)
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]


@pytest.mark.parametrize(
    ("factors", "told"),
    [
        ([1, 1, 1, 3.6], r"72 km/h by positions, at 3\.6 times this speed as given"),
        ([1, 0.25, 1, 4], "vehicles drive 288 km/h"),
        ([1, 1, 0.01, 0.01], r"vehicles drive 0\.72 km/h"),
    ],
)
@pytest.mark.filterwarnings("ignore:no vehicle is on the mainline")
def test_units_that_are_given_are_kept_and_what_is_odd_is_told(factors, told, tmp_path):
    path = plain(tmp_path / "a.csv", stream(seconds=240.0) * np.array(factors))
    with pytest.warns(UserWarning, match=rf"a\.csv: units, as given: time in s, .*{told}"):
        imported = run(path, dataclasses.replace(PLAIN, units=UNITS))
    speed = record_of(imported).speed
    np.testing.assert_allclose(speed, 72.0 * factors[3], rtol=1e-4)


def test_what_is_in_memory_is_a_bucket_not_the_file(tmp_path, monkeypatch):
    read, sizes, imported = pl.read_parquet, [], []

    def watched(files):
        table = read(files)
        sizes.append(table.height)
        return table

    monkeypatch.setattr(pl, "read_parquet", watched)
    points = stream()
    for size in (2 * len(points), len(points) // 4):
        monkeypatch.setattr(recording, "BUCKET_ROWS", size)
        imported.append(run(plain(tmp_path / str(size) / "a.csv", points)))
    assert sizes[0] == sum(sizes[1:]) == len(points)
    assert max(sizes[1:]) < len(points) / 2
    at_once, in_buckets = (record_of(each).counts for each in imported)
    np.testing.assert_array_equal(in_buckets, at_once)
