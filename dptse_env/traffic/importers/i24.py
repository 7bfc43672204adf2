"""I-24 MOTION: a JSON array with a document for each vehicle, with lists of times and positions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dptse_env.traffic.importers.points import (
    Labels,
    Points,
    TrajectoryError,
    open_bytes,
    open_error,
    require_numbers,
)
from dptse_env.traffic.importers.source import Source
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.extras import needed_for

CHUNK_POINTS = 100_000
"""Points that are handed on together."""

_LISTS = ("timestamp", "x_position", "y_position")


class I24:
    """Reads I-24 MOTION files; there are no speeds in them. A row is a document."""

    units: Mapping[str, str] = {"time": "s", "length": "ft", "speed": "ft/s"}

    def read(self, path: Path, source: Source) -> Iterator[Points]:
        """Read a file in chunks.

        Raises:
            TrajectoryError: The file is damaged, or a document lacks a field.
            MissingExtraError: ijson is not installed.
        """
        problem = open_error(path)
        if problem is not None:
            raise problem
        with needed_for("JSON of trajectories"):
            import ijson  # noqa: PLC0415  (optional)
        row, waiting = 0, []
        try:
            with open_bytes(path) as file:
                for document in ijson.items(_WithoutMark(file), "item", use_float=True):
                    row += 1
                    one = _document(path, row, document, source)
                    if one is not None:
                        waiting.append(one)
                    if sum(len(each["time"]) for each in waiting) >= CHUNK_POINTS:
                        yield _points(waiting, source)
                        waiting = []
        except (ijson.JSONError, EOFError, OSError) as broken:
            raise TrajectoryError(
                f"{path}, row {row + 1}: it is no complete JSON array: {broken}"
            ) from broken
        if waiting:
            yield _points(waiting, source)
        if not row:
            raise TrajectoryError(f"{path}: it must be a JSON array of documents, got none")


class _WithoutMark:
    """A file without its byte-order mark."""

    def __init__(self, file: Any) -> None:
        self._file, self._started = file, False

    def read(self, size: int = -1) -> bytes:
        block: bytes = self._file.read(size)
        if not self._started and size != 0:
            self._started = True
            block = block.removeprefix(b"\xef\xbb\xbf")
        return block


def _document(path: Path, row: int, document: Any, source: Source) -> dict[str, Any] | None:
    """Return the lists of a document, or None if it is not wanted."""
    if not isinstance(document, Mapping):
        raise TrajectoryError(f"{path}, row {row}: a document must be an object, got {document!r}")
    wanted = (*_LISTS, "direction", *source.where)
    missing = [name for name in ("_id", *wanted) if name not in document]
    if missing:
        raise TrajectoryError(
            f"{path}, row {row}: fields {', '.join(missing)} are missing, found "
            f"{', '.join(document)}"
        )
    for name, value in source.where.items():
        if document[name] != value and str(document[name]) != str(value):
            return None
    lists = {name: _numbers(path, row, name, document[name]) for name in _LISTS}
    sizes = {name: len(values) for name, values in lists.items()}
    if len(set(sizes.values())) > 1:
        raise TrajectoryError(f"{path}, row {row}: lists must be of one length, got {sizes}")
    identity = document["_id"]
    name = identity.get("$oid", identity) if isinstance(identity, Mapping) else identity
    return {
        "row": row, "vehicle": str(name), "group": str(document["direction"]),
        "time": lists["timestamp"], "x": lists["x_position"], "y": lists["y_position"],
    }  # fmt: skip


def _numbers(path: Path, row: int, name: str, values: Any) -> FloatArray:
    try:
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as problem:
        raise TrajectoryError(
            f"{path}, row {row}: {name} must be a list of numbers, got {str(values)[:60]}"
        ) from problem
    if numbers.ndim != 1:
        raise TrajectoryError(f"{path}, row {row}: {name} must be a list, got {str(values)[:60]}")
    require_numbers(path, np.full(len(numbers), row), name, numbers)
    return numbers


def _points(documents: list[dict[str, Any]], source: Source) -> Points:
    sizes = [len(one["time"]) for one in documents]
    length = source.factor("length", I24.units["length"])

    def joined(key: str) -> FloatArray:
        return np.concatenate([one[key] for one in documents])

    def labels(key: str) -> Labels:
        names = tuple(dict.fromkeys(one[key] for one in documents))
        places = {name: place for place, name in enumerate(names)}
        codes = [places[one[key]] for one in documents]
        return Labels(np.repeat(np.array(codes, dtype=np.int32), sizes), names)

    return Points(
        row=np.repeat([one["row"] for one in documents], sizes),
        time=joined("time") * source.factor("time", I24.units["time"]),
        vehicle=labels("vehicle"),
        x=joined("x") * length,
        y=joined("y") * length,
        group=labels("group"),
    )
