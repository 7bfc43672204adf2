"""SUMO's floating-car data of a shipped corridor give the very records of the recorder."""

import dataclasses
import gzip

import numpy as np
import pytest

from dptse_env.traffic import SHORT_HIGHWAY, Record, RecordLibrary, simulate, sumo
from dptse_env.importers import (
    Layout,
    Source,
    Split,
    TrajectoryError,
    import_trajectories,
)
from dptse_env.traffic.sumo_network import edge_ids

TRAINING = [Split("training", 1.0, range(1000))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fcd")


@pytest.fixture(scope="module")
def recorded(folder):
    """Record a seed once for each kind of FCD file; return the record."""
    options = sumo.OPTIONS
    try:
        for suffix in ("xml", "csv", "parquet"):
            output = "--fcd-output", str(folder / f"fcd.{suffix}"), "--precision", "17"
            sumo.OPTIONS = (*options, *output)
            record = simulate(SHORT_HIGHWAY, 3)
    finally:
        sumo.OPTIONS = options
    (folder / "fcd.xml.gz").write_bytes(gzip.compress((folder / "fcd.xml").read_bytes()))
    return record


def run(folder, name, tmp_path, source=Source("fcd")):  # noqa: B008
    return import_trajectories([folder / name], source, SHORT_HIGHWAY, tmp_path / "new", TRAINING)


@pytest.mark.parametrize("suffix", ["xml.gz", "csv", "parquet"])
def test_imported_fcd_is_the_record_number_for_number(suffix, folder, recorded, tmp_path):
    imported = run(folder, f"fcd.{suffix}", tmp_path)
    record = RecordLibrary(tmp_path).get(imported.corridor, 0)
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(record, name), getattr(recorded, name))
    assert (record.n_steps, record.n_columns) == (recorded.n_steps, recorded.n_columns)


def cut(folder, name, size, tmp_path):
    path = tmp_path / name
    path.write_bytes((folder / name).read_bytes()[:size])
    return path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fcd.xml.gz", r"fcd\.xml\.gz, row \d+: it is no complete XML file"),
        ("fcd.csv", r"fcd\.csv, row \d+.*Expected 11 columns"),
        ("fcd.parquet", r"fcd\.parquet: it is no complete Parquet file"),
    ],
)
def test_truncated_files_are_refused(name, message, folder, recorded, tmp_path):
    size = (folder / name).stat().st_size
    path = cut(folder, name, size * 2 // 3, tmp_path)
    if name == "fcd.csv":  # within a line: at its end nothing would be missing
        path.write_bytes(path.read_bytes().rpartition(b"\n")[0] + b"\n150.000;12;3.0")
    with pytest.raises(TrajectoryError, match=message):
        import_trajectories([path], Source("fcd"), SHORT_HIGHWAY, tmp_path / "new", TRAINING)
    assert sorted(each.name for each in tmp_path.iterdir()) == [name]


def test_edges_that_the_road_does_not_have_are_named(folder, recorded, tmp_path):
    source = Source("fcd", layout=Layout(edges={"A0": 0.0}))
    with pytest.raises(TrajectoryError, match=r"must be on the road, got .*such as .*main_0"):
        run(folder, "fcd.csv", tmp_path, source)
    with pytest.raises(ValueError, match=r"layout\.edges\.A0 must be one of main_0"):
        run(folder, "fcd.csv", tmp_path, Source("fcd", layout=Layout(edges={"A0": "main_9"})))


def test_an_uneven_road_with_long_ramps_is_imported_number_for_number(tmp_path, monkeypatch):
    lengths = (0.1, 0.15, 0.08, 0.1, 0.12, 0.1)
    road = dataclasses.replace(
        SHORT_HIGHWAY, segment_length=lengths, ramp_segments=(2, 3), duration=90
    )
    output = "--fcd-output", str(tmp_path / "fcd.csv"), "--precision", "17"
    monkeypatch.setattr(sumo, "OPTIONS", (*sumo.OPTIONS, *output))
    recorded = simulate(road, 0)
    imported = import_trajectories(
        [tmp_path / "fcd.csv"], Source("fcd"), road, tmp_path / "new", TRAINING
    )
    record = RecordLibrary(tmp_path).get(imported.corridor, 0)
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(record, name), getattr(recorded, name))
    # By position: edges of the mainline start at kilometres.
    edges = {name: name for name in edge_ids(road)}
    edges |= {f"main_{i}": float(sum(lengths[:i])) for i in range(6)}
    source = Source("fcd", layout=Layout(edges=edges))
    imported = import_trajectories(
        [tmp_path / "fcd.csv"], source, road, tmp_path / "other", TRAINING
    )
    record = RecordLibrary(tmp_path).get(imported.corridor, 0)
    assert (record.counts != recorded.counts).mean() < 0.005
