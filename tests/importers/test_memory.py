"""Memory does not grow with the file: rows wait on disk."""

import tracemalloc
from dataclasses import dataclass

import numpy as np
import pytest

from dptse_env.importers import FORMATS, Labels, Points, Source, Split, recording, spill
from tests.cases import fast_and_slow
from tests.importers.data import run

CHUNK = 2_000
TRIP = 200
"""Points of a vehicle: 20 s at 20 m/s, 0.1 s apart."""


@dataclass
class Stream:
    """A format whose points are made as they are asked for, by vehicle or by time."""

    n_vehicles: int
    by_vehicle: bool
    units = FORMATS["table"].units

    def read(self, path, source):
        for first in range(0, self.n_vehicles * TRIP, CHUNK):
            row = np.arange(first, first + CHUNK)
            vehicle, point = row // TRIP, row % TRIP  # one vehicle after another
            if not self.by_vehicle:  # ten vehicles at once, second by second
                group, place = np.divmod(row, 10 * TRIP)
                vehicle, point = 10 * group + place % 10, place // 10
            names, codes = np.unique(vehicle, return_inverse=True)
            x = 0.002 * point + 0.0001
            labels = Labels(codes.astype(np.int32), tuple(map(str, names)))
            yield Points(row, 2.0 * vehicle + 0.1 * point, labels, x, None, 72.0 + 0.0 * x)


@pytest.mark.parametrize("by_vehicle", fast_and_slow([True, False], [False]))
def test_four_times_the_points_need_no_more_memory(by_vehicle, tmp_path, monkeypatch):
    # Small buckets, so that a small file already has many of them.
    monkeypatch.setattr(recording, "BUCKET_BYTES", 2e5)
    monkeypatch.setattr(spill, "MOST_WAITING", 6_000)
    monkeypatch.setattr(recording, "PICTURE_POINTS", 100)
    monkeypatch.setattr("dptse_env.importers.folder.write_report", lambda *_: {})
    peaks = []
    for number, n_vehicles in enumerate((200, 200, 800)):
        monkeypatch.setitem(FORMATS, "table", Stream(n_vehicles, by_vehicle))
        folder = tmp_path / f"{number}"
        folder.mkdir()
        path = folder / "points"
        path.write_bytes(b" " * 50 * TRIP * n_vehicles)  # by its size the buckets are counted
        if number > 0:  # the first import of a process imports modules
            tracemalloc.start()
        run(path, Source("table"), splits=[Split("training", 1.0, range(1000))])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    _, smaller, larger = peaks
    assert larger < 0.5 * 50 * TRIP * 800, "the check would not see all rows in memory"
    assert larger < 1.6 * smaller  # ids and windows take some
