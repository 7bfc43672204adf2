"""Files of each format, with the quirks of the real ones."""

import gzip
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from dptse_env.traffic import RecordLibrary
from dptse_env.importers import Layout, Part, Source, TrajectoryError
from dptse_env.importers.tables import NGSIM_COLUMNS
from tests.importers.data import PLAIN, first_file, plain, run, stream, write_csv

FOOT = 0.3048
EPOCH = 1118846979700  # NGSIM's clocks do not begin at a whole second


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Counts of the first record of the stream, at seconds from its start."""
    path = plain(tmp_path_factory.mktemp("plain") / "a.csv", stream())
    return counts(run(path))


def counts(imported, seed=0):
    return RecordLibrary().get(imported.corridor, seed).counts


def ngsim(points, shift=300.0):
    """Return the 18 columns of a stream, `shift` ms later than `EPOCH` and its times."""
    vehicle, time, x, speed = points.T
    n = len(points)
    values = (
        vehicle + 1, 1 + 10 * time, np.full(n, 200), EPOCH + shift + 1000 * time, np.full(n, 18.2),
        x / FOOT, np.full(n, 6451137.641), np.full(n, 1873344.962), np.full(n, 14.5),
        np.full(n, 4.9), np.full(n, 2), speed / FOOT, np.zeros(n), np.full(n, 2), np.zeros(n),
        np.zeros(n), np.zeros(n), np.zeros(n),
    )  # fmt: skip
    whole = {"Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "v_Class", "Lane_ID"}
    return {
        name: column.round().astype(int) if name in whole else column.round(3)
        for name, column in zip(NGSIM_COLUMNS, values, strict=True)
    }


def test_ngsim_text_is_in_columns_of_blanks_without_a_header(tmp_path, expected):
    columns = ngsim(stream())
    rows = zip(*columns.values(), strict=True)
    lines = ["  " + "   ".join(f"{value:>9}" for value in row) + "  " for row in rows]
    path = tmp_path / "trajectories-0750am-0805am.txt"
    path.write_text("\r\n".join(lines) + "\r\n")
    imported = run(path, Source("ngsim"))
    np.testing.assert_array_equal(counts(imported), expected)
    assert imported.report["windows"][0]["start"] == (EPOCH + 300) / 1000


def test_ngsims_portal_has_a_header_more_columns_and_other_sites(tmp_path, expected):
    columns = ngsim(stream())
    columns = {name: columns[name] for name in reversed(columns)}
    n = len(columns["Vehicle_ID"])
    columns |= {"O_Zone": [""] * n, "Location": ["us-101"] * n}
    other = ",".join("nowhere" if name == "Location" else "1" for name in columns)
    path = write_csv(tmp_path / "portal.csv", columns, head="\ufeff", lines=[other] * 3)
    imported = run(path, Source("ngsim", where={"Location": "us-101"}))
    np.testing.assert_array_equal(counts(imported), expected)
    assert first_file(imported)["rows"] == n


def highd(points, folder, period=0.04):
    """Write a recording: even vehicles move to the right, odd ones to the left, on 400 m."""
    vehicle, time, x, speed = points.T
    left = vehicle % 2 == 1
    length = 4.6
    columns = {
        "frame": (1 + time / period).round().astype(int), "id": (vehicle + 1).astype(int),
        # x is the left corner of the box, the front of those that move to the left
        "x": np.where(left, 400.0 - x, x - length).round(3), "y": np.where(left, 8.5, 22.0),
        "width": np.full(len(x), length), "height": np.full(len(x), 1.9),
        "xVelocity": np.where(left, -speed, speed), "yVelocity": np.zeros(len(x)),
        "laneId": np.where(left, 3, 6),
    }  # fmt: skip
    path = write_csv(folder / "01_tracks.csv", columns)
    distinct = np.unique(vehicle).astype(int)
    directions = np.where(distinct % 2 == 1, 1, 2)
    meta = {"id": distinct + 1, "drivingDirection": directions}
    write_csv(folder / "01_tracksMeta.csv", meta)
    return path


def test_highd_has_both_directions_and_corners_of_boxes(tmp_path):
    points = stream(period=0.04)
    path = highd(points, tmp_path)
    imported = run(path, Source("highd", layout=Layout(extent=400.0)))
    groups = [(w["group"], w["start"]) for w in imported.report["windows"]]
    assert groups[:4] == [("upper", 1.0), ("lower", 1.0), ("upper", 22.0), ("lower", 22.0)]
    file = first_file(imported)
    assert file["rows"] == len(points)
    assert file["entered"] == 29
    upper, lower = (RecordLibrary().get(imported.corridor, seed) for seed in (0, 1))
    for record in (upper, lower):
        first = record.vehicle == record.vehicle[0]
        assert (np.diff(record.segment[first][record.segment[first] < 4]) >= 0).all()
        np.testing.assert_allclose(record.speed, 72.0, rtol=1e-5)


def test_one_direction_of_highd_may_be_chosen(tmp_path, expected):
    points = stream(period=0.04, headway=2.0)
    points = points[points[:, 0] % 2 == 0]
    both = np.concatenate([points, points + np.array([1, 0, 0, 0])])
    path = highd(both, tmp_path)
    with pytest.raises(TrajectoryError, match=r"layout\.extent must be given, .* \['lower'\]"):
        run(path, Source("highd"))
    imported = run(path, Source("highd", groups=("lower",)))
    assert {window["group"] for window in imported.report["windows"]} == {"lower"}
    # frame 1 is at 0.04 s: the grid is the file's
    assert abs(counts(imported)[:, :4].sum() - expected[:20, :4].sum()) <= 12
    assert first_file(imported)["other_group"] == len(points)


def test_exid_has_frames_lanelets_in_lists_and_a_plane(tmp_path, expected):
    points = stream(period=0.04)
    vehicle, time, x, speed = points.T
    columns = {
        "recordingId": np.full(len(x), 7), "trackId": vehicle.astype(int),
        "frame": (time * 25).round().astype(int), "xCenter": (100 + 0.6 * x).round(4),
        "yCenter": (-50 - 0.8 * x).round(4), "heading": np.full(len(x), 306.9),
        "width": np.full(len(x), 1.9), "length": np.full(len(x), 4.6),
        "lonVelocity": speed, "latVelocity": 0 * x,
        "laneletId": ["1500;1502" if s > 200 else "1500" for s in x],
        "latLaneCenterOffset": ["0.1;-3.2" if s > 200 else "0.1" for s in x],
        "laneChange": np.zeros(len(x), dtype=int),
    }  # fmt: skip
    line = ((100.0, -50.0), (340.0, -370.0))
    layout = Layout(centre_line=line, mainline=Part(lanes=(1500, 1501)))
    imported = run(write_csv(tmp_path / "07_tracks.csv", columns), Source("exid", layout=layout))
    np.testing.assert_array_equal(counts(imported), expected)
    assert imported.report["windows"][0]["group"] == "7"


def i24(points, direction=1, first=0):
    """Return documents of a stream, as MongoDB exports them."""
    documents = []
    for vehicle in np.unique(points[:, 0]):
        _, time, x, _ = points[points[:, 0] == vehicle].T
        place = 310000.0 + direction * x / FOOT
        documents.append({
            "_id": {"$oid": f"{first + int(vehicle):024x}"},
            "timestamp": (1.6691e9 + time).tolist(),
            "x_position": place.tolist(), "y_position": [direction * 20.0] * len(x),
            "direction": direction, "length": [15.0, 15.1], "flags": [None, "a"],
            "first_timestamp": 1.6691e9 + time[0], "coarse_vehicle_class": 0,
        })  # fmt: skip
    return documents


def test_i24_is_an_array_of_documents_by_vehicle_without_speeds(tmp_path, expected):
    path = tmp_path / "i24.json"
    path.write_text("\ufeff" + json.dumps(i24(stream()) + i24(stream(), -1, 500)))
    with pytest.raises(TrajectoryError, match=r"\d+ % of the vehicles"):
        run(path, Source("i24", layout=Layout(origin=310000.0)))
    east = Source("i24", where={"direction": 1}, layout=Layout(origin=310000.0))
    imported = run(path, east)
    np.testing.assert_array_equal(counts(imported), expected)
    np.testing.assert_allclose(RecordLibrary().get(imported.corridor, 0).speed, 72.0, rtol=1e-3)
    (tmp_path / "west").mkdir()
    path = path.rename(tmp_path / "west" / "i24.json")
    west = Source("i24", groups=(-1,), layout=Layout(origin=310000.0, reversed=True))
    np.testing.assert_array_equal(counts(run(path, west)), expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (json.dumps(i24(stream()))[:-2000], r"row \d+: it is no complete JSON array"),
        ("[]", "must be a JSON array of documents, got none"),
        ("[3]", "row 1: a document must be an object, got 3"),
        ('[{"_id": 1}]', "row 1: fields timestamp, x_position, y_position, direction are missing"),
        (json.dumps([{**i24(stream())[0], "x_position": [1.0]}]), "row 1: lists must"),
    ],
)
def test_bad_json_is_named_by_document_and_field(text, message, tmp_path):
    path = tmp_path / "i24.json"
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=message):
        run(path, Source("i24", layout=Layout(origin=310000.0)))


@pytest.mark.parametrize("sign", ["-", "_"])
def test_tgsim_has_runs_and_two_spellings(sign, tmp_path, expected):
    vehicle, time, x, speed = stream().T
    columns = {
        "id": vehicle.astype(int), "time": time.round(1), f"xloc{sign}kf": (x + 30.0).round(4),
        f"yloc{sign}kf": 0 * x, f"lane{sign}kf": 0 * x + 1, f"speed{sign}kf": speed,
        f"run{sign}index": 0 * x.astype(int) + 3,
    }  # fmt: skip
    path = write_csv(tmp_path / "tgsim.csv", columns)
    imported = run(path, Source("tgsim", layout=Layout(origin=30.0)))
    np.testing.assert_array_equal(counts(imported), expected)
    assert imported.report["windows"][0]["group"] == "3"


def test_tables_may_be_parquet_compressed_or_by_other_delimiters(tmp_path, expected):
    path = plain(tmp_path / "a.csv", stream())
    text = path.read_text()
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "semicolons.csv").write_text(text.replace(",", ";"))
    (tmp_path / "tabs.txt").write_text("\ufeff" + text.replace(",", "\t"))
    vehicle, time, x, speed = stream().T
    table = pa.table({"t": time.round(4), "id": vehicle.astype(int), "s": x.round(4), "v": speed})
    pa.parquet.write_table(table, tmp_path / "a.parquet")
    for name in ("a.csv.gz", "semicolons.csv", "tabs.txt", "a.parquet"):
        folder = tmp_path / name.replace(".", "-")
        folder.mkdir()
        imported = run([(tmp_path / name).rename(folder / name)])
        np.testing.assert_array_equal(counts(imported), expected, name)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"t,id,s,v\n", "must have rows of vehicles, got none"),
        (b"t,id,s,v\n0,1,2,3\n1,1,2\n", "row 3: .*Expected 4 columns, got 3"),
        (b"t,id,s,v\n0,1,2,3\n1,1,here,3\n", "row 3: s: .*invalid value 'here'"),
        (b"t,id,s,v\n0,1,2,3\n1,1,,3\n", "row 3: s must be a finite number, got nan"),
        (b"t,id,x,v\n0,1,2,3\n", r"source\.columns\.x must be .*'s'; found t, id, x, v"),
    ],
)
def test_bad_tables_are_named_by_row_and_field(content, message, tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(TrajectoryError, match=message) as refused:
        run(path, PLAIN)
    assert str(refused.value).startswith(str(path))


def test_a_directory_or_a_missing_file_is_refused(tmp_path):
    with pytest.raises(TrajectoryError, match="must be a file, got a directory"):
        run(tmp_path / "..", PLAIN)
    with pytest.raises(TrajectoryError, match="the file cannot be read: No such file"):
        run(tmp_path / "none.csv", PLAIN)
    with pytest.raises(TrajectoryError, match="the file cannot be read: No such file"):
        run(tmp_path / "none.json", Source("i24"))
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(TrajectoryError, match="it is no complete Parquet file"):
        run(tmp_path / "a.parquet", PLAIN)
    (tmp_path / "a.csv.gz").write_bytes(b"not compressed")
    with pytest.raises(TrajectoryError, match="the file cannot be read: Not a gzipped file"):
        run(tmp_path / "a.csv.gz", PLAIN)


@pytest.mark.parametrize(("missing", "name"), [("pyarrow", "a.csv"), ("ijson", "a.json")])
def test_a_missing_library_is_named_with_its_extra(missing, name, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, missing, None)
    (tmp_path / name).write_text("t,id,s,v\n0,1,2,3\n")
    source = PLAIN if missing == "pyarrow" else Source("i24")
    with pytest.raises(ImportError, match=rf"{missing}, .*'dptse-env\[corridors\]'"):
        run(tmp_path / name, source)
