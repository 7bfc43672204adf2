"""What is done so far: a CSV file that only grows, and survives being cut off."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
import typing
from collections.abc import Hashable, Iterable, Iterator
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar


class Key(Hashable, Protocol):
    """A frozen dataclass of plain values: what is run on every traffic seed."""

    __dataclass_fields__: typing.ClassVar[dict[str, Any]]


class Cell(Key, Protocol):
    """A key that is one configuration of an environment."""

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it."""


class Scored(Protocol):
    """A dataclass that says something about one episode."""

    __dataclass_fields__: typing.ClassVar[dict[str, Any]]

    @property
    def traffic_seed(self) -> int:
        """The traffic of the episode."""


KeyT = TypeVar("KeyT", bound=Key)
CellT = TypeVar("CellT", bound=Cell)
ScoredT = TypeVar("ScoredT", bound=Scored)


class Ledger(Generic[KeyT, ScoredT]):
    """One record for each (cell, traffic seed), on disk as soon as it is added.

    A process that dies while it writes leaves a last line without its end. Such a line is
    dropped when the file is opened again; what it said is then run again.

    Attributes:
        path: The CSV file.
        rows: Records by cell and traffic seed.
    """

    def __init__(self, path: Path, cell_type: type[KeyT], record_type: type[ScoredT]) -> None:
        """Read what is there.

        Args:
            path: The CSV file.
            cell_type: Its fields are the first columns.
            record_type: Its fields are the others.

        Raises:
            ValueError: A line but a torn last one is not as this class writes it.
        """
        self.path, self._cell_type, self._type = path, cell_type, record_type
        self._cell_fields = _parsers(cell_type)
        self._record_fields = _parsers(record_type)
        self.columns = (*self._cell_fields, *self._record_fields)
        self.rows: dict[tuple[KeyT, int], ScoredT] = {}
        if path.exists():
            self._read()

    def _read(self) -> None:
        whole, end, torn = self.path.read_text(encoding="utf-8").rpartition("\n")
        if torn:
            # In place: what is kept is never written twice, so it cannot be lost here.
            os.truncate(self.path, len((whole + end).encode()))
        if not whole:
            return
        lines = csv.reader(io.StringIO(whole))
        header = tuple(next(lines))
        if header != self.columns:
            raise ValueError(
                f"{self.path} must have the columns {', '.join(self.columns)}; it has "
                f"{', '.join(header)}: remove it or choose another folder"
            )
        for number, line in enumerate(lines, start=2):
            try:
                key, record = self._parse(line)
            except ValueError as problem:
                raise ValueError(f"{self.path}, line {number}: {problem}") from problem
            self.rows[key] = record

    def _parse(self, line: list[str]) -> tuple[tuple[KeyT, int], ScoredT]:
        if len(line) != len(self.columns):
            raise ValueError(f"must have {len(self.columns)} values, has {len(line)}")
        values = iter(line)
        cell = self._cell_type(
            **{name: parse(next(values)) for name, parse in self._cell_fields.items()}
        )
        record = self._type(
            **{name: parse(next(values)) for name, parse in self._record_fields.items()}
        )
        return (cell, record.traffic_seed), record

    def append(self, cell: KeyT, records: Iterable[ScoredT]) -> None:
        """Add what one task found, and put it on disk before returning."""
        records = list(records)
        new = not self.path.exists() or self.path.stat().st_size == 0
        with self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            if new:
                writer.writerow(self.columns)
            writer.writerows(self._line(cell, record) for record in records)
            file.flush()
            os.fsync(file.fileno())
        self.rows.update({(cell, record.traffic_seed): record for record in records})

    def sort(self) -> None:
        """Put the file in an order that does not depend on how the run went."""
        aside = self.path.with_suffix(".tmp")
        with aside.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(self.columns)
            writer.writerows(self._sorted())
        aside.replace(self.path)

    def _sorted(self) -> Iterator[list[Any]]:
        def order(item: tuple[tuple[KeyT, int], ScoredT]) -> tuple[Any, ...]:
            (cell, seed), _ = item
            return (*dataclasses.astuple(cell), seed)

        for (cell, _), record in sorted(self.rows.items(), key=order):
            yield self._line(cell, record)

    @staticmethod
    def _line(cell: Any, record: Any) -> list[Any]:
        return [*dataclasses.astuple(cell), *dataclasses.astuple(record)]


def _parsers(cls: type) -> dict[str, type]:
    """Return the type of each field: str, int or float, each of which parses what it prints."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}
