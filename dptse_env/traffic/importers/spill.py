"""Rows that wait on disk in buckets, so that memory does not grow with a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dptse_env.utils.arrays import IntArray

Rows = NDArray[np.void]
"""A structured array."""

MOST_WAITING = 500_000
"""Rows that are kept in memory before they are written."""


class Spill:
    """Buckets of rows of one type, each a file of a folder."""

    def __init__(self, folder: Path, dtype: np.dtype[Any]) -> None:
        """Make the folder."""
        folder.mkdir()
        self._folder, self._dtype = folder, dtype
        self._waiting: list[tuple[IntArray, Rows]] = []
        self._n_waiting = 0

    def append(self, bucket: IntArray, rows: Rows) -> None:
        """Append rows to their buckets, each in the order given."""
        self._waiting.append((bucket, rows))
        self._n_waiting += len(rows)
        if self._n_waiting >= MOST_WAITING:
            self._flush()

    def take(self, bucket: int) -> Rows:
        """Return the rows of a bucket, and remove it."""
        self._flush()
        path = self._path(bucket)
        if not path.exists():
            return np.empty(0, dtype=self._dtype)
        rows = np.fromfile(path, dtype=self._dtype)
        path.unlink()
        return rows

    def _flush(self) -> None:
        if not self._n_waiting:
            return
        bucket, rows = (np.concatenate(each) for each in zip(*self._waiting, strict=True))
        self._waiting, self._n_waiting = [], 0
        order = np.argsort(bucket, kind="stable")
        bucket, rows = bucket[order], rows[order]
        numbers, first = np.unique(bucket, return_index=True)
        for number, part in zip(numbers.tolist(), np.split(rows, first[1:]), strict=True):
            with self._path(number).open("ab") as file:
                file.write(part.tobytes())

    def _path(self, bucket: int) -> Path:
        return self._folder / f"{bucket}"
