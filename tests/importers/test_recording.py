"""What becomes of points: whole seconds, gaps, ids that are used again, bad rows."""

import dataclasses

import numpy as np
import pytest

from dptse_env.traffic import RecordLibrary
from dptse_env.importers import Layout, Source, TrajectoryError
from tests.importers.data import (
    PLAIN,
    ROAD,
    SPLITS,
    first_file,
    plain,
    run,
    stream,
)


def record_of(imported, seed=0):
    return RecordLibrary().get(imported.corridor, seed)


def test_windows_follow_one_another_and_are_split_by_time(tmp_path):
    imported = run(plain(tmp_path / "a.csv", stream(seconds=124.0)))
    assert imported.seeds == {"training": (0, 1, 2), "validation": (1000,), "test": (2000,)}
    starts = [window["start"] for window in imported.report["windows"]]
    assert starts == [0.0, 21.0, 42.0, 63.0, 84.0]  # 20 s and the second 0: they share none
    assert [window["seed"] for window in imported.report["windows"]] == [0, 1, 2, 1000, 2000]


def test_a_pause_between_windows_and_skipped_ends(tmp_path):
    path = plain(tmp_path / "a.csv", stream(seconds=125.0))
    imported = run(path, pause=9, skip_start=5.0, skip_end=20.0)
    assert [window["start"] for window in imported.report["windows"]] == [5.0, 35.0, 65.0]


def test_several_files_are_several_recordings(tmp_path):
    paths = [plain(tmp_path / f"{name}.csv", stream(seconds=45.0)) for name in "abc"]
    imported = run(paths)
    windows = [(window["file"], window["start"]) for window in imported.report["windows"]]
    assert windows == [(f"{name}.csv", start) for name in "abc" for start in (0.0, 21.0)]
    assert {name: len(each) for name, each in imported.seeds.items()} == {
        "training": 4, "validation": 1, "test": 1
    }  # fmt: skip


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
    def branch(vehicle, x):
        on, off = (vehicle % 3 == 1) & (x < 150), (vehicle % 3 == 2) & (x > 250)
        return np.where(on, 7, np.where(off, 8, 1))

    points = stream(length=600.0)
    points[:, 2] -= 150.0
    lane = branch(points[:, 0], points[:, 2])
    path = plain(tmp_path / "a.csv", points, lane=lane, y=np.where(lane == 1, 0.0, 5.0 * lane))
    parts = {
        "lane": ({"lanes": [7]}, {"lanes": [8]}, {"lanes": [1]}),
        "y": ({"lateral": [30, 37]}, {"lateral": [37, 45]}, {"lateral": [-3, 3]}),
    }
    counts = []
    for role, (on, off, mainline) in parts.items():
        layout = {"on_ramps": [on], "off_ramps": [off], "mainline": mainline}
        source = dataclasses.replace(
            PLAIN, columns={**PLAIN.columns, role: role}, layout=layout_of(layout)
        )
        folder = tmp_path / role
        folder.mkdir()
        imported = run([path.rename(folder / "a.csv")], source, ROAD)
        path = folder / "a.csv"
        counts.append(record_of(imported).counts)
        assert first_file(imported)["off_lanes"] == 0
        assert imported.corridor.demand.on_ramps[0] == pytest.approx(300.0, rel=0.3)
    np.testing.assert_array_equal(*counts)
    total = counts[0].sum(axis=0)
    # Vehicles of the ramp are on it to the face at 100 m, then on the mainline, as on lane 7 at
    # 100 to 150 m; those of the off-ramp likewise.
    columns = ("main_0", "main_1", "main_2", "main_3", "on_0", "off_0")
    shares = dict(zip(columns, total[:6] / total[2], strict=True))
    assert shares["main_0"] == pytest.approx(2 / 3, abs=0.15)
    assert shares["on_0"] == pytest.approx(1 / 3, abs=0.15)
    assert shares["main_1"] == pytest.approx(1.0, abs=0.15)
    assert shares["main_3"] == pytest.approx(2 / 3, abs=0.15)
    assert shares["off_0"] == pytest.approx(1 / 3, abs=0.15)


def layout_of(fields):
    from dptse_env.utils.fields import from_mapping

    return from_mapping(Layout, fields, "layout")


def test_a_curved_road_is_straightened_by_its_centre_line(tmp_path):
    points = stream()
    angle = points[:, 2] / 1000.0  # a bend of 1 km radius, to the left
    x, y = 1000.0 * np.sin(angle), 1000.0 * (1.0 - np.cos(angle))
    line = [(1000.0 * np.sin(a), 1000.0 * (1.0 - np.cos(a))) for a in np.linspace(0, 0.5, 26)]
    source = Source(
        "table",
        {"time": "t", "vehicle": "id", "x": "px", "y": "py", "speed": "v"},
        layout=Layout(centre_line=tuple(line)),
    )
    straight = record_of(run(plain(tmp_path / "a.csv", points)))
    (tmp_path / "bent").mkdir()
    bent = run(plain(tmp_path / "bent" / "b.csv", points, px=x, py=y), source)
    np.testing.assert_array_equal(record_of(bent).counts, straight.counts)


def test_units_and_direction(tmp_path):
    points = stream()
    feet = points * [1.0, 1000.0, -1 / 0.3048, 3600 / 1609.344]
    feet[:, 2] += 5000.0
    source = dataclasses.replace(
        PLAIN,
        units={"time": "ms", "length": "ft", "speed": "mi/h"},
        layout=Layout(origin=5000.0, reversed=True),
    )
    straight = record_of(run(plain(tmp_path / "a.csv", points)))
    (tmp_path / "feet").mkdir()
    record = record_of(run(plain(tmp_path / "feet" / "b.csv", feet), source))
    np.testing.assert_array_equal(record.counts, straight.counts)
    np.testing.assert_allclose(record.speed, straight.speed, rtol=1e-4)


def test_short_gaps_are_filled_and_longer_ones_cut(tmp_path):
    points = stream()
    vehicle, time = points[:, 0], points[:, 1]
    filled = (vehicle == 10) & (time > 26.05) & (time < 28.05)
    cut = (vehicle == 11) & (time > 28.05) & (time < 36.05)
    imported = run(plain(tmp_path / "a.csv", points[~filled & ~cut]))
    file = first_file(imported)
    assert (file["gaps_filled"], file["seconds_filled"]) == (1, 2)
    assert (file["gaps_cut"], file["pieces"]) == (1, file["vehicles"] + 1)
    assert (file["vanished"], file["appeared"]) == (1, 1)
    record = record_of(imported, 1)  # seconds 21 to 41
    assert (record.vehicle == 10).any()
    assert record.counts[27 - 21].sum() == record.counts[26 - 21].sum()


def test_vehicles_are_conserved_in_the_report(tmp_path):
    file = first_file(run(plain(tmp_path / "a.csv", stream())))
    assert file["present_at_start"] + file["entered"] + file["appeared"] == file["pieces"]
    assert file["present_at_end"] + file["left"] + file["vanished"] == file["pieces"]
    assert file["appeared"] == file["vanished"] == 0
    assert file["entered"] == 30 - 1
    assert file["rows"] == file["seconds"] * 10 + 4 or file["rows"] > 9 * file["seconds"]


def test_an_id_that_is_used_again_is_another_vehicle(tmp_path):
    points = stream(headway=4.0)
    points[:, 0] %= 8  # a vehicle is there for 20 s, its id is free again after 12 s
    imported = run(plain(tmp_path / "a.csv", points))
    file = first_file(imported)
    assert file["vehicles"] == 8
    assert file["pieces"] == len(np.unique(stream(headway=4.0)[:, 0]))
    record = record_of(imported, 1)
    steps = [np.sort(record.step[record.vehicle == v]) for v in np.unique(record.vehicle)]
    assert all((np.diff(each) == 1).all() for each in steps)


def test_a_jump_to_another_place_cuts(tmp_path):
    points = stream()
    late = (points[:, 0] == 12) & (points[:, 1] > 34.0)
    points[late, 2] -= 150.0
    file = first_file(run(plain(tmp_path / "a.csv", points)))
    assert (file["jumps_cut"], file["pieces"]) == (1, file["vehicles"] + 1)


def test_rows_in_any_order_and_duplicates_give_the_same_records(tmp_path):
    points = stream()
    ordered = run(plain(tmp_path / "a.csv", points))
    (tmp_path / "b").mkdir()
    mixed = np.concatenate([points, points[100:140]])[::-1]
    shuffled = run(plain(tmp_path / "b" / "b.csv", mixed))
    file = first_file(shuffled)
    assert file["duplicates"] == 40
    assert file["out_of_order"] > 100
    for seed in (0, 1, 2000):
        one, other = record_of(ordered, seed), record_of(shuffled, seed)
        np.testing.assert_array_equal(one.counts, other.counts)
        np.testing.assert_allclose(one.speed_sums, other.speed_sums)


def test_rows_off_the_road_are_dropped_and_counted(tmp_path):
    points = stream()
    lane = np.where(points[:, 0] == 3, 9, 1)
    points[points[:, 0] == 5, 2] += 1000.0
    source = dataclasses.replace(
        PLAIN,
        columns={**PLAIN.columns, "lane": "lane"},
        layout=layout_of({"mainline": {"lanes": [1]}}),
    )
    imported = run(plain(tmp_path / "a.csv", points, lane=lane), source)
    file = first_file(imported)
    assert file["off_lanes"] == (points[:, 0] == 3).sum()
    assert file["off_ends"] == (points[:, 0] == 5).sum()
    assert file["off_the_road"] == ["9"]
    text = (tmp_path / "imported" / "report.md").read_text()
    assert f"| {file['off_ends']} | dropped: before the road's start or beyond its end |" in text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p * [1, 1, 1, 3.6], r"speeds 3\.6 times as large .*speed in km/h$"),
        (lambda p: p * [1, 1, -1, 1] + [0, 0, 400, 0], r"layout\.reversed must be turned round"),
        (lambda p: p * [1, 1, 1, np.nan], r"row 2: v must be a finite number, got nan"),
        (lambda p: p * [1, 1, 1, 1] + [0, 0, 900, 0], r"rows must be on the road, got \d+ of \d+"),
        (lambda p: p[p[:, 1] < 15.0], r"it must last 21 s or more, .*, got 15 s"),
        (
            lambda p: np.concatenate([p, p[:1] + np.array([0, 0, 30, 0])]),
            r"rows 2 and \d+: a vehicle must be in one place at a time, got 0\.\d+ km and 0\.\d+",
        ),
    ],
)
def test_bad_points_are_refused(change, message, tmp_path):
    path = plain(tmp_path / "a.csv", change(stream()))
    with pytest.raises(TrajectoryError, match=message) as refused:
        run(path)
    assert str(refused.value).startswith(str(path))
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]


def test_both_directions_in_one_file_need_a_choice(tmp_path):
    points = stream()
    back = points[:, 0] % 2 == 1
    points[back, 2] = 400.0 - points[back, 2]
    with pytest.raises(TrajectoryError, match=r"one direction must be chosen .* 49 %|one direct"):
        run(plain(tmp_path / "a.csv", points))


def test_other_errors_name_the_option(tmp_path):
    path = plain(tmp_path / "a.csv", stream())
    with pytest.raises(ValueError, match="shares must be"):
        run(path, splits=[SPLITS[0]._replace(share=0.5)])
    with pytest.raises(ValueError, match="at most 1 windows of split training, got 3"):
        run(path, splits=[SPLITS[0]._replace(seeds=range(1)), *SPLITS[1:]])
    with pytest.raises(ValueError, match=r"source\.format must be one of fcd, ngsim"):
        run(path, Source("csv"))
    with pytest.raises(ValueError, match=r"layout\.on_ramps must be one part for each of the 0"):
        run(path, dataclasses.replace(PLAIN, layout=layout_of({"on_ramps": [{"lanes": [1]}]})))
    with pytest.raises(ValueError, match=r"layout needs lanes"):
        run(path, dataclasses.replace(PLAIN, layout=layout_of({"mainline": {"lanes": [1]}})))
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]
    run(path)
    with pytest.raises(ValueError, match="output must be a folder that does not exist yet"):
        run(path)


def test_an_interruption_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    path = plain(tmp_path / "a.csv", stream())
    monkeypatch.setattr("dptse_env.importers.folder.write_report", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(path)
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]
