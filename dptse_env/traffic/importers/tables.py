"""Tables of trajectories in CSV files, Parquet files and plain text, read in chunks.

Only the columns that are needed are parsed, and one chunk is in memory at a time.
"""

from __future__ import annotations

import csv
import importlib
import io
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from dptse_env.traffic.importers.points import Labels, TrajectoryError, open_bytes, open_error
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.extras import needed_for

CHUNK_BYTES = 2 << 20
"""Bytes of a text file that are parsed at a time."""
CHUNK_ROWS = 1 << 17
"""Rows of a Parquet file that are read at a time."""
HEAD_BYTES = 1 << 16
"""Bytes at the start of a text file by which its delimiter and columns are told."""
PARQUET = (".parquet", ".pq")


class Chunk(NamedTuple):
    """Rows of a table: their numbers as a reader of the file counts them, and their columns."""

    row: IntArray
    numbers: dict[str, FloatArray]
    labels: dict[str, Labels]


class Head(NamedTuple):
    """Format of a text file, as its start shows it: columns, delimiter, lines above the data."""

    columns: list[str]
    delimiter: str
    header_lines: int
    grouped_digits: bool


def arrow() -> Any:
    """Return the package pyarrow.

    Raises:
        MissingExtraError: It is not installed.
    """
    with needed_for("a table of trajectories"):
        for module in ("compute", "csv", "parquet"):
            importlib.import_module(f"pyarrow.{module}")
        return importlib.import_module("pyarrow")


def is_parquet(path: Path) -> bool:
    """Return whether a file is a Parquet file, by its name."""
    return path.suffix.lower() in PARQUET


def normalised(name: str) -> str:
    """Return a column's name without regard to case, blanks, hyphens and underscores."""
    return re.sub(r"[\s_-]+", "_", name.strip()).lower()


def column_names(path: Path, text_columns: tuple[str, ...] = ()) -> list[str]:
    """Return the names of a table's columns; `text_columns` are those of a text without header."""
    problem = open_error(path)
    if problem is not None:
        raise problem
    if is_parquet(path):
        with _open_parquet(path) as file:
            return list(file.schema_arrow.names)
    return read_head(path, text_columns).columns


def read_table(
    path: Path, numbers: Mapping[str, str], labels: Mapping[str, str], text_columns: tuple[str, ...]
) -> Iterator[Chunk]:
    """Read columns of a table in chunks.

    Args:
        path: The file; text may be compressed by gzip.
        numbers: Columns of numbers by the key that they get; an empty field is NaN.
        labels: Columns of names by key.
        text_columns: Names of the columns of a text without header, separated by blanks.

    Raises:
        TrajectoryError: The file is damaged, or a field is no number; with its row.
    """
    pa = arrow()
    batches = _parquet(path, {**numbers, **labels}) if is_parquet(path) else None
    first = 1
    if batches is None:
        head = read_head(path, text_columns)
        first = 1 + head.header_lines
        batches = _text(path, head, tuple(numbers.values()), tuple(labels.values()))
    try:
        for batch in batches:
            row = np.arange(first, first + batch.num_rows)
            first += batch.num_rows
            yield Chunk(
                row,
                {key: _numbers(pa, batch.column(name)) for key, name in numbers.items()},
                {key: _labels(pa, batch.column(name)) for key, name in labels.items()},
            )
    except (pa.ArrowException, EOFError, OSError) as problem:
        # "In CSV column #3: Row #12: ..."; rows are counted as in an editor.
        message = str(problem)
        place = re.search(r"Row #(\d+)", message)
        where = f", row {place[1]}" if place else f", after row {first - 1}"
        column = re.search(r"column #(\d+)", message)
        field = f": {column_names(path, text_columns)[int(column[1])]}" if column else ""
        raise TrajectoryError(f"{path}{where}{field}: {message}") from problem


def read_head(path: Path, text_columns: tuple[str, ...] = ()) -> Head:
    """Tell the columns and the delimiter of a text file from its first lines.

    Raises:
        TrajectoryError: It has no line, or one without a name for each column.
    """
    try:
        with open_bytes(path) as file:
            text = file.read(HEAD_BYTES).decode("utf-8-sig", errors="replace")
    except (OSError, EOFError) as problem:
        raise TrajectoryError(f"{path}: the file cannot be read: {problem}") from problem
    lines = text.splitlines()
    if not lines or not lines[0].strip():
        raise TrajectoryError(f"{path}, row 1: a header or data must be there, got an empty line")
    first = lines[0]
    delimiter = max(",;\t|", key=first.count)
    if not first.count(delimiter):
        delimiter = " "
    names = first.split() if delimiter == " " else next(csv.reader([first], delimiter=delimiter))
    if text_columns and _is_number(names[0]):
        if len(names) != len(text_columns):
            raise TrajectoryError(
                f"{path}, row 1: a line without header must have {len(text_columns)} columns "
                f"({', '.join(text_columns)}), got {len(names)}"
            )
        return Head(list(text_columns), delimiter, 0, False)
    grouped = delimiter == "," and re.search(r'"\d{1,3}(,\d{3})+(\.\d*)?"', text) is not None
    return Head([name.strip() for name in names], delimiter, 1, grouped)


def _text(
    path: Path, head: Head, numbers: tuple[str, ...], labels: tuple[str, ...]
) -> Iterator[Any]:
    pa = arrow()
    # "1,118,846,663,000": portals export numbers with their digits in groups.
    number = pa.string() if head.grouped_digits else pa.float64()
    types = dict.fromkeys(labels, pa.dictionary(pa.int32(), pa.string()))
    # A column of both kinds is read as text, and made what is asked for later.
    types |= {name: pa.string() if name in types else number for name in numbers}
    columns = list(dict.fromkeys([*numbers, *labels]))
    with open_bytes(path) as file:
        stream = _Squeezed(file) if head.delimiter == " " else file
        reader = pa.csv.open_csv(
            pa.PythonFile(stream, "r"),
            pa.csv.ReadOptions(
                use_threads=False, block_size=CHUNK_BYTES, column_names=head.columns,
                skip_rows=head.header_lines,
            ),
            pa.csv.ParseOptions(delimiter=head.delimiter),
            pa.csv.ConvertOptions(
                column_types=types, include_columns=columns, strings_can_be_null=True
            ),
        )  # fmt: skip
        yield from reader


def _parquet(path: Path, columns: Mapping[str, str]) -> Iterator[Any]:
    with _open_parquet(path) as file:
        names = list(dict.fromkeys(columns.values()))
        yield from file.iter_batches(CHUNK_ROWS, columns=names, use_threads=False)


def _open_parquet(path: Path) -> Any:
    pa = arrow()
    try:
        # Buffered, or a file with a single group of rows would be in memory as a whole.
        return pa.parquet.ParquetFile(path, buffer_size=1 << 20, pre_buffer=False)
    except (pa.ArrowException, OSError) as problem:
        raise TrajectoryError(f"{path}: it is no complete Parquet file: {problem}") from problem


def _numbers(pa: Any, column: Any) -> FloatArray:
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        column = pa.compute.replace_substring(column, ",", "")
    values: FloatArray = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    return values


def _labels(pa: Any, column: Any) -> Labels:
    """Return a column of names; a missing one is the empty name."""
    if not pa.types.is_dictionary(column.type):
        column = column.cast(pa.string()).dictionary_encode()
    names = tuple(column.dictionary.to_pylist())
    codes = column.indices.fill_null(len(names)).to_numpy(zero_copy_only=False)
    return Labels(codes.astype(np.int32), (*names, ""))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class _Squeezed(io.RawIOBase):
    """A text of columns that are separated by runs of blanks, with a single blank instead."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._rest = file, b""

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        """Return complete lines of about `size` bytes, or nothing at the end."""
        block = self._file.read(size)
        text = self._rest + block
        end = text.rfind(b"\n") + 1 if block else len(text)
        lines, self._rest = text[:end], text[end:]
        if block and not lines:
            return self.read(size)
        return b"".join(b" ".join(line.split()) + b"\n" for line in lines.splitlines())
