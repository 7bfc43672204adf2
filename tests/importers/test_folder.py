"""The folder of an import: splits, seeds, and all or nothing."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from dptse_env.importers import Layout, Source, Strip
from dptse_env.importers.folder import assign_seeds, new_folder
from tests.importers.data import PLAIN, ROAD, SPLITS, plain, run, stream


def test_several_files_are_several_recordings(tmp_path):
    paths = [plain(tmp_path / f"{name}.csv", stream(seconds=45.0)) for name in "abc"]
    imported = run(paths)
    windows = [(window["file"], window["start"]) for window in imported.report["windows"]]
    assert windows == [(f"{name}.csv", start) for name in "abc" for start in (0.0, 21.0)]
    assert {name: len(each) for name, each in imported.seeds.items()} == {
        "training": 4, "validation": 1, "test": 1
    }  # fmt: skip
    assert imported.corridor.measured == ("demand", "exit_shares", "average_dwell")


def test_every_split_has_a_window_if_it_can():
    splits = [
        split._replace(share=share) for split, share in zip(SPLITS, (0.8, 0.1, 0.1), strict=True)
    ]
    assert assign_seeds(splits, 3) == {"training": (0,), "validation": (1000,), "test": (2000,)}
    assert assign_seeds(splits, 1) == {"training": (0,), "validation": (), "test": ()}


def test_a_road_is_measured_on_the_first_windows_that_there_are(tmp_path):
    path = plain(tmp_path / "a.csv", stream())
    tests = [split._replace(share=float(split.name == "test")) for split in SPLITS]
    imported = run(path, splits=tests)
    assert [len(each) for each in imported.seeds.values()] == [0, 0, 5]
    assert imported.corridor.measured == ("demand", "exit_shares", "average_dwell")


def test_other_errors_name_the_option(tmp_path):
    path = plain(tmp_path / "a.csv", stream())
    lanes = Strip(lanes=(1,))
    for message, arguments in {
        "shares must be": {"splits": [SPLITS[0]._replace(share=0.5)]},
        "at most 1 windows of split training, got 3": {
            "splits": [SPLITS[0]._replace(seeds=range(1)), *SPLITS[1:]]
        },
        r"source\.format must be one of fcd, ngsim": {"source": Source("csv")},
        r"layout\.on_ramps must be one strip for each of the 0": {
            "source": dataclasses.replace(PLAIN, layout=Layout(on_ramps=(lanes,)))
        },
        r"layout needs lanes": {
            "source": dataclasses.replace(PLAIN, layout=Layout(mainline=lanes))
        },
        r"pause must be": {"pause": -21},
    }.items():
        with pytest.raises(ValueError, match=message):
            run(path, **arguments)
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]
    run(path)
    with pytest.raises(ValueError, match="output must not exist yet, got "):
        run(path)


def test_an_interruption_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    def cut_off(*_):
        raise ValueError("0.parquet is malformed")

    path = plain(tmp_path / "a.csv", stream())
    monkeypatch.setattr("dptse_env.importers.folder.write_report", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(path)
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]
    with monkeypatch.context() as patch:  # a file that was cut off looks malformed
        patch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=0))
        patch.setattr("dptse_env.importers.folder.write_report", cut_off)
        with pytest.raises(OSError, match=r"No space left .*imported"):
            run(path)
    # A process that is killed leaves a folder, which the same command removes.
    for name in (".imported-", ".imported-else-"):
        (tmp_path / (name + 32 * "f") / "result").mkdir(parents=True)
    with pytest.raises(KeyboardInterrupt):
        run(path)
    left = {each.name for each in tmp_path.iterdir()}
    assert left == {"a.csv", ".imported-else-" + 32 * "f"}


def test_two_imports_to_one_folder_do_not_touch_each_other(tmp_path):
    output = tmp_path / "imported"
    with new_folder(output) as folder:
        (folder / "work").touch()
        with (
            pytest.raises(
                ValueError, match=r"output must be made by one .*imported, which another"
            ),
            new_folder(output),
        ):
            pass
    assert [each.name for each in output.iterdir()] == ["work"]
    assert [each.name for each in tmp_path.iterdir()] == ["imported"]


def test_a_mainline_that_nobody_drives_on_is_told(tmp_path):
    points = stream(length=250.0)
    lanes = Layout(mainline=Strip(lanes=(1,)), on_ramps=(Strip(lanes=(7,)),))
    source = Source("table", {**PLAIN.columns, "lane": "lane"}, layout=lanes)
    with pytest.warns(UserWarning, match=r"on the mainline's segments 4 of 4: are layout\.origin"):
        told = run(
            plain(tmp_path / "a.csv", points, lane=np.ones(len(points), dtype=int)), source, ROAD
        )
    unused = "on-ramp at face 1", "off-ramp at face 3"
    assert told.report["notes"] == [f"no vehicle is ever on the {ramp}" for ramp in unused]
    (tmp_path / "imported").rename(tmp_path / "first")
    path = plain(tmp_path / "b.csv", points, lane=np.full(len(points), 7))
    with pytest.raises(ValueError, match="files must be with vehicles on the mainline"):
        run(path, source, ROAD.replaced(on_ramps=(3,), off_ramps=(), exit_shares=()))
    assert {each.name for each in tmp_path.iterdir()} == {"a.csv", "first", "b.csv"}


def test_windows_that_begin_empty_are_told(tmp_path):
    points = stream(seconds=45.0)
    early = points[:, 1] < 5.0
    kept = ~early | (points[:, 2] < 90.0)  # at first all are on the ramp, which joins at 100 m
    path = plain(tmp_path / "a.csv", points[kept], lane=np.where(early, 7, 1)[kept])
    lanes = Layout(mainline=Strip(lanes=(1,)), on_ramps=(Strip(lanes=(7,)),))
    source = Source("table", {**PLAIN.columns, "lane": "lane"}, layout=lanes)
    notes = run(path, source, ROAD).report["notes"]
    assert "windows begin on an empty mainline: traffic seeds 0" in notes
    assert not [note for note in notes if "on-ramp" in note]  # taken in the first window
    assert "- note: windows begin" in (tmp_path / "imported" / "report.md").read_text()
