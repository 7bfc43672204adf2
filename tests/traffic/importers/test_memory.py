"""Memory does not grow with the file: rows wait on disk."""

import tracemalloc

import numpy as np
import pytest

from dptse_env.traffic.importers import Split, recording, spill, tables
from tests.traffic.importers.data import plain, run, stream


@pytest.mark.parametrize("by_vehicle", [True, False])
def test_a_file_of_four_times_the_size_needs_no_more_memory(by_vehicle, tmp_path, monkeypatch):
    # Small chunks and buckets, so that small files already are many of them.
    monkeypatch.setattr(tables, "CHUNK_BYTES", 1 << 14)
    monkeypatch.setattr(recording, "BUCKET_BYTES", 2e5)
    monkeypatch.setattr(spill, "MOST_WAITING", 10_000)
    monkeypatch.setattr(recording, "PICTURE_POINTS", 100)
    monkeypatch.setattr("dptse_env.traffic.importers.folder.write_report", lambda *_: {})
    peaks = []
    for seconds in (100.0, 600.0, 2400.0):
        folder = tmp_path / f"{seconds:.0f}"
        folder.mkdir()
        points = stream(seconds=seconds)
        if not by_vehicle:
            points = points[np.argsort(points[:, 1], kind="stable")]
        path = plain(folder / "a.csv", points)
        tracemalloc.start()
        run(path, splits=[Split("training", 1.0, range(1000))])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    _, smaller, larger = peaks  # the first one imported modules
    assert larger < path.stat().st_size, "the check would not see a file in memory"
    assert larger < 1.6 * smaller  # not 4: windows and ids take some
