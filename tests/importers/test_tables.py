"""Files of each format, with the quirks of the real ones, and damaged ones."""

import dataclasses
import gzip
import io
import json
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from dptse_env.importers import Layout, Source, Split, Strip, TrajectoryError, import_trajectories
from dptse_env.importers.tables import NGSIM_COLUMNS
from dptse_env.traffic import SHORT_HIGHWAY, Record, RecordLibrary, simulate, sumo
from dptse_env.traffic.sumo_input import edge_ids
from tests.importers.data import PLAIN, first_file, plain, run, stream, write_csv

FOOT = 0.3048
TRAINING = [Split("training", 1.0, range(1000))]
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


def text_of_ngsim(points):
    rows = zip(*ngsim(points).values(), strict=True)
    return ["  " + "   ".join(f"{value:>9}" for value in row) + "  " for row in rows]


def test_ngsim_text_is_in_columns_of_blanks_without_a_header(tmp_path, expected):
    path = tmp_path / "trajectories-0750am-0805am.txt"
    path.write_text("\r\n".join(text_of_ngsim(stream())) + "\r\n\r\n  \r\n")
    imported = run(path, Source("ngsim"))
    np.testing.assert_array_equal(counts(imported), expected)
    assert imported.report["windows"][0]["start"] == (EPOCH + 300) / 1000


def test_ngsims_portal_has_a_header_grouped_digits_and_other_sites(tmp_path, expected):
    columns = ngsim(stream())
    columns = {name: columns[name] for name in reversed(columns)}
    n = len(columns["Vehicle_ID"])
    columns["Global_Time"] = [f'"{time:,}"' for time in columns["Global_Time"]]
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
    write_csv(folder / "01_tracksMeta.csv", {"id": distinct + 1, "drivingDirection": directions})
    return path


def test_highd_has_both_directions_and_corners_of_boxes(tmp_path, expected):
    points = stream(period=0.04)
    path, layout = highd(points, tmp_path), Layout(extent=400.0)
    with pytest.raises(TrajectoryError, match=r"layout\.extent must be given, .* \['lower'\]"):
        run(path, Source("highd"))
    imported = run(path, Source("highd", layout=layout))
    groups = [(w["group"], w["start"]) for w in imported.report["windows"]]
    assert groups[:4] == [("lower", 1.0), ("upper", 1.0), ("lower", 22.0), ("upper", 22.0)]
    file = first_file(imported)
    assert (file["rows"], file["entered"]) == (len(points), 29)
    records = [RecordLibrary().get(imported.corridor, seed) for seed in (0, 1)]
    for record in records:
        first = record.vehicle == record.vehicle[0]
        assert (np.diff(record.segment[first][record.segment[first] < 4]) >= 0).all()
        np.testing.assert_allclose(record.speed, 72.0, rtol=1e-5)
    # frame 1 is at 0.04 s: the grid is the file's
    both = sum(record.counts[:, :4].sum() for record in records)
    assert abs(both - expected[:20, :4].sum()) <= 12
    (tmp_path / "imported").rename(tmp_path / "both")
    lower = run(path, Source("highd", groups=("lower",)))  # one needs no extent
    np.testing.assert_array_equal(counts(lower), records[0].counts)
    assert first_file(lower)["other_group"] == (points[:, 0] % 2 == 1).sum()
    (tmp_path / "imported").rename(tmp_path / "lower")
    (tmp_path / "01_tracksMeta.csv").write_text("id,drivingDirection\n1,2\n")
    with pytest.raises(TrajectoryError, match=r"vehicle \d+ is not in .*_tracksMeta\.csv"):
        run(path, Source("highd"))


def test_exid_has_frames_lanelets_in_lists_and_a_plane(tmp_path, expected):
    vehicle, time, x, speed = stream(period=0.04).T
    columns = {
        "recordingId": np.full(len(x), 7), "trackId": vehicle.astype(int),
        "frame": (time * 25).round().astype(int), "xCenter": (100 + 0.6 * x).round(4),
        "yCenter": (-50 - 0.8 * x).round(4), "heading": np.full(len(x), 306.9),
        "lonVelocity": speed, "laneletId": ["1500;1502" if s > 200 else "1500" for s in x],
    }  # fmt: skip
    line = ((100.0, -50.0), (340.0, -370.0))
    layout = Layout(centre_line=line, mainline=Strip(lanes=(1500, 1501)))
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
        })  # fmt: skip
    return documents


LISTS = ("timestamp", "x_position", "y_position")


def test_i24_is_an_array_of_documents_by_vehicle_without_speeds(tmp_path, expected, monkeypatch):
    path = tmp_path / "i24.json"
    path.write_text("\ufeff" + json.dumps(i24(stream()) + i24(stream(), -1, 500)), "utf-8")
    with pytest.raises(TrajectoryError, match=r"\d+ % of the vehicles"):
        run(path, Source("i24", layout=Layout(origin=310000.0)))
    east = Source("i24", where={"direction": 1}, layout=Layout(origin=310000.0))
    with monkeypatch.context() as patch:
        patch.setattr("dptse_env.importers.tables.LARGEST_JSON", 1000)
        with pytest.raises(TrajectoryError, match=r"most 1000 bytes, got more: .*Parquet or CSV"):
            run(path, east)
    imported = run(path, east)
    np.testing.assert_array_equal(counts(imported), expected)
    np.testing.assert_allclose(RecordLibrary().get(imported.corridor, 0).speed, 72.0, rtol=1e-3)
    (tmp_path / "west").mkdir()
    path = path.rename(tmp_path / "west" / "i24.json")
    west = Source("i24", groups=(-1,), layout=Layout(origin=310000.0, reversed=True))
    np.testing.assert_array_equal(counts(run(path, west)), expected)


def test_i24_may_be_a_table_with_a_row_for_each_point(tmp_path, expected):
    documents = i24(stream())
    table = pl.DataFrame(
        {name: [each[name] for each in documents] for name in (*LISTS, "direction")}
        | {"_id": [each["_id"]["$oid"] for each in documents]}
    ).explode(LISTS)
    table.write_parquet(tmp_path / "i24.parquet")
    imported = run(tmp_path / "i24.parquet", Source("i24", layout=Layout(origin=310000.0)))
    np.testing.assert_array_equal(counts(imported), expected)


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


@pytest.mark.parametrize("folder", ["data [2]", "~"])
def test_tables_of_all_kinds_have_paths_that_are_no_patterns(
    folder, tmp_path, monkeypatch, expected
):
    monkeypatch.chdir(tmp_path)
    folder = Path(folder)
    folder.mkdir()
    text = plain(folder / "p[1].csv", stream()).read_text("utf-8")
    (folder / "p[1].csv.gz").write_bytes(gzip.compress(text.encode()))
    (folder / "semicolons.csv").write_text(text.replace(",", ";").replace("\n", "\n\n", 3))
    (folder / "tabs.txt").write_text("\ufeff" + text.replace(",", "\t"), "utf-8")
    (folder / "blanks [1].txt").write_text(text.replace(",", " "))
    pl.read_csv(io.StringIO(text)).write_parquet(tmp_path / folder / "p[1].parquet")
    for path in [*folder.iterdir()]:
        np.testing.assert_array_equal(counts(run(path)), expected, path.name)
        shutil.rmtree(folder / "imported")
    with pytest.raises(TrajectoryError, match=r"p\*\.csv: the file cannot be read: No such file"):
        run(folder / "p*.csv")
    run(highd(stream(), folder), Source("highd", groups=("lower",)))


def test_a_column_is_that_of_its_own_spelling(tmp_path, expected):
    path = plain(tmp_path / "a.csv", stream(), S=0.0 * stream()[:, 2])
    fold = dataclasses.replace(PLAIN, columns={**PLAIN.columns, "x": "s "})
    with pytest.raises(TrajectoryError, match=r"columns\.x must be .* 's '; found \['s', 'S'\]"):
        run(path, fold)
    np.testing.assert_array_equal(counts(run(path)), expected)


LONG = "x" * 100_000
DOCUMENT = i24(stream())[0]
POINT = pl.DataFrame({"t": [0], "id": 1, "s": 2, "v": 3})
DATES, NESTED = io.BytesIO(), io.BytesIO()
POINT.cast({"t": pl.Date}).write_parquet(DATES)
POINT.with_columns(pl.concat_list(pl.lit("a")).alias("id")).write_parquet(NESTED)
BAD = {
    "a.csv": [
        ("", "the file is empty"),
        ("t,id,s,v\n", "must have rows of vehicles, got none"),
        ("t,id,s,v\n0,1,2,3\n1,1,here,3\n", "row 3: s must be a finite number, got 'here'"),
        ("t,id,s,v\n0,1,2,3\n\n1,1,,3\n", "row 4: s must be a finite number, got nothing"),
        ("t,id,x,v\n0,1,2,3\n", r"source\.columns\.x must be .*'s'; found \['t', 'id', 'x', 'v'\]"),
        (b"t,id,s,v\n0,\xff,2,3\n", "must be text in UTF-8, got invalid utf-8 sequence"),
        ("t,id,s,v\n0,1,2,3\n".encode("utf-16"), "must be text in UTF-8, got bytes of 0"),
        (b"PK\x03\x04\x14\x00 a.csv", "got bytes of 0, as in UTF-16 and in packed files"),
        ("t;id;s;v\n0;1;2,5;3\n", "row 2: s must be a finite number with a point, got '2,5'"),
        ("t,\rid,s,v\n0,1,2,3\n", "the file cannot be read: new-line character"),
        (f"t,id,s,v\n0,1,{LONG},3\n", "row 2: s must be"),
        (f"t,id,{LONG},v\n", "row 1: it must have 3 fields, got 4"),
        (",".join(f"c{i}" for i in range(10_000)), "source.columns.time must be"),
        ("t,id,s,v\n0,1,2,3\n0,2,2,3,7\n", "row 3: it must have 4 fields, got 5$"),
        ("t,id,s,v\n0,1,2,3\n0,2,2\n", "row 3: it must have 4 fields, got 3$"),
        ('t,id,s,v\n0,1,2,"3\n0,2,2,3"\n', "row 2: it must have 4 fields, got an open quote$"),
        (None, "the file cannot be read: No such file"),
    ],
    "a.txt": [
        ("1 " * 18 + "\n\n" + "1 " * 17, "row 3: it must have 18 fields, got 17$"),
        ("1 " * 17, r"row 1: a line without header must have 18 columns .*, got 17$"),
    ],
    "a.csv.gz": [
        ("not compressed", r"source\.columns\.time must be a column of the file, got 't'"),
        (gzip.compress(b"t,id,s,v" * 99)[:-9], "the file cannot be read: Compressed file ended"),
        (gzip.compress(b"t,id,s,v\n0,1,2\n"), "row 2: it must have 4 fields, got 3$"),
    ],
    "a.parquet": [
        ("PAR1 and no more", "it is no complete Parquet file"),
        (DATES.getvalue(), "got Date"),
        (NESTED.getvalue(), r"id must be numbers or texts, got List\(String\)"),
    ],
    "a.json": [
        (json.dumps(i24(stream()))[:-2000], "JSON must be a complete array of documents, .*Syntax"),
        ("[" * 100_000, "JSON must be a complete array of documents"),
        ("[]", r"columns must be timestamp, _id, x_position among others, found \[\]"),
        (json.dumps([{**dict.fromkeys(LISTS, ()), "_id": 1, "direction": 1}]), "got none"),
        ("[3]", "JSON must be a complete array of documents"),
        ('[{"_id": 1}]', r"columns must be timestamp, x_position among others, found \['_id'\]"),
        (json.dumps([{**DOCUMENT, "x_position": [1.0]}]), "with lists of one length"),
        (json.dumps([{**DOCUMENT, "x_position": 1.0}]), "with lists of one length"),
        (
            json.dumps([{**DOCUMENT, "x_position": ["a"] * len(DOCUMENT["x_position"])}]),
            "row 1: x_position must be a finite number, got 'a'",
        ),
        (None, "the file cannot be read: No such file"),
    ],
    "..": [(None, "must be a file, got a directory")],
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_named_by_row_and_field_in_few_words(name, tmp_path):
    path = tmp_path / name
    i24 = Source("i24", layout=Layout(origin=310000.0))
    source = {"a.json": i24, "a.txt": Source("ngsim")}.get(name, PLAIN)
    for content, message in BAD[name]:
        if content is None:
            path.unlink() if path.is_file() else None
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(TrajectoryError, match=message) as refused:
            run(path, source)
        assert str(refused.value).startswith(str(path))
        assert len(str(refused.value)) < 500 + len(str(path))


# -- SUMO ------------------------------------------------------------------------------------------


def import_fcd(path, folder, road=SHORT_HIGHWAY, **fields):
    imported = import_trajectories([path], Source("fcd", **fields), road, folder / "new", TRAINING)
    return RecordLibrary(folder).get(imported.corridor, 0)


def output_to(path):
    """Return options of SUMO, which runs in a temporary folder, with a name in plain ASCII."""
    return "--fcd-output", f"../{os.path.relpath(path, tempfile.gettempdir())}", "--precision", "17"


@pytest.fixture(scope="module")
def fcd(tmp_path_factory):
    """Record a seed once for each kind of FCD file; return their folder and the record."""
    folder, options = tmp_path_factory.mktemp("fcd"), sumo.OPTIONS
    try:
        for suffix in ("xml", "csv", "parquet"):
            sumo.OPTIONS = (*options, *output_to(folder / f"fcd.{suffix}"))
            record = simulate(SHORT_HIGHWAY, 3)
    finally:
        sumo.OPTIONS = options
    (folder / "fcd.xml.gz").write_bytes(gzip.compress((folder / "fcd.xml").read_bytes()))
    return folder, record


@pytest.mark.parametrize("suffix", ["xml.gz", "csv", "parquet"])
def test_imported_fcd_is_the_record_number_for_number(suffix, fcd, tmp_path):
    folder, recorded = fcd
    record = import_fcd(folder / f"fcd.{suffix}", tmp_path)
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(record, name), getattr(recorded, name))
    assert (record.n_steps, record.n_columns) == (recorded.n_steps, recorded.n_columns)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fcd.xml", r", row \d+: it is no complete XML file"),
        ("fcd.xml.gz", r", row \d+: it is no complete XML file"),
        ("fcd.parquet", ": it is no complete Parquet file"),
    ],
)
def test_files_that_are_cut_are_refused(name, message, fcd, tmp_path):
    content = (fcd[0] / name).read_bytes()
    (tmp_path / name).write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(TrajectoryError, match=rf"{name}{message}"):
        import_fcd(tmp_path / name, tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_fcd_that_does_not_fit_the_road_is_refused(fcd, tmp_path):
    path = fcd[0] / "fcd.csv"
    with pytest.raises(TrajectoryError, match=r"must be on the road, got .*such as .*main_0"):
        import_fcd(path, tmp_path, layout=Layout(edges={"A0": 0.0}))
    with pytest.raises(ValueError, match=r"layout\.edges\.A0 must be one of main_0"):
        import_fcd(path, tmp_path, layout=Layout(edges={"A0": "main_9"}))
    (tmp_path / "a.xml").write_text(
        '<a>\n<timestep time="0.00">\n<vehicle id="1" lane="main_0_0" speed="3"/></timestep></a>'
    )
    with pytest.raises(TrajectoryError, match=r"a\.xml, row 3: .* lane, speed, pos; 'pos' is miss"):
        import_fcd(tmp_path / "a.xml", tmp_path)


def test_an_uneven_road_with_long_ramps_is_imported_number_for_number(tmp_path, monkeypatch):
    lengths = (0.1, 0.15, 0.08, 0.1, 0.12, 0.1)
    road = SHORT_HIGHWAY.replaced(segment_length=lengths, ramp_segments=(2, 3), duration=90)
    path = tmp_path / "fcd.csv"
    monkeypatch.setattr(sumo, "OPTIONS", (*sumo.OPTIONS, *output_to(path)))
    recorded = simulate(road, 0)
    record = import_fcd(path, tmp_path / "by-edge", road)
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(record, name), getattr(recorded, name))
    # By position: edges of the mainline start at kilometres.
    edges = {name: name for name in edge_ids(road.geometry)}
    edges |= {f"main_{i}": float(sum(lengths[:i])) for i in range(6)}
    record = import_fcd(path, tmp_path / "by-position", road, layout=Layout(edges=edges))
    assert (record.counts != recorded.counts).mean() < 0.005
