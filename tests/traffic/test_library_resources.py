"""Open files and memory of a library with many records."""

import gc
import os
import tracemalloc
from pathlib import Path

import pytest

from dptse_env.traffic import SHORT_HIGHWAY, Record, RecordLibrary
from tests.traffic.test_library import tiny_record

N_OPEN = 64


def n_descriptors():
    return len(os.listdir("/dev/fd"))  # noqa: PTH208  (entries come and go while it is read)


@pytest.fixture(scope="module")
def thousand(tmp_path_factory):
    path: Path = tmp_path_factory.mktemp("thousand")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        for seed in range(1000):
            tiny_record(path, seed)
    return path


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/fd").is_dir(), reason="descriptors cannot be counted here")
def test_descriptors_stay_bounded_over_a_thousand_records(thousand):
    records = RecordLibrary(thousand, n_open=N_OPEN)
    gc.collect()
    before, most = n_descriptors(), 0
    for seed in range(1000):
        records.get(SHORT_HIGHWAY, seed)
        most = max(most, n_descriptors())
    assert most - before == len(Record.COLUMNS) * N_OPEN
    del records
    gc.collect()
    assert n_descriptors() == before


@pytest.mark.slow
def test_memory_stays_flat_over_many_records(thousand):
    records = RecordLibrary(thousand, n_open=N_OPEN)

    def read(seeds):
        for seed in seeds:
            assert records.get(SHORT_HIGHWAY, seed).counts.sum() == 1
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        after_few, after_all = read(range(2 * N_OPEN)), read(range(2 * N_OPEN, 300))
    finally:
        tracemalloc.stop()
    assert after_few > 1_000_000  # 64 open records with their counts
    assert after_all - after_few < 50_000
