"""Results on disk: a CSV file that only grows and survives an interrupted write."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from agents.experiments.cells import KeyT
from agents.files import write_csv


class Scored(Protocol):
    """A dataclass of what was measured in one episode."""

    __dataclass_fields__: typing.ClassVar[dict[str, Any]]

    @property
    def traffic_seed(self) -> int:
        """The traffic of the episode."""


ScoredT = TypeVar("ScoredT", bound=Scored)


class Ledger(Generic[KeyT, ScoredT]):
    """A record for each key and traffic seed, on disk as soon as it is added.

    A process that dies while it writes leaves a last line without its end. Such a line is dropped
    when the file is opened again, and its episode is run again.

    Attributes:
        path: The CSV file.
        rows: Records by key and traffic seed.
    """

    def __init__(self, path: Path, key_type: type[KeyT], record_type: type[ScoredT]) -> None:
        """Read the file, if there is one; the fields of both types are its columns, in order.

        Raises:
            ValueError: A line other than a torn last one is not as this class writes it.
        """
        self.path, self._key_type, self._record_type = path, key_type, record_type
        self._key_fields = _parsers(key_type)
        self._record_fields = _parsers(record_type)
        self.columns = (*self._key_fields, *self._record_fields)
        self.rows: dict[tuple[KeyT, int], ScoredT] = {}
        if path.exists():
            self._read()

    def _read(self) -> None:
        lines, end, torn = self.path.read_text(encoding="utf-8").rpartition("\n")
        if torn:
            # Cut in place: complete lines are never written again, so they cannot be lost here.
            os.truncate(self.path, len((lines + end).encode()))
        if not lines:
            return
        reader = csv.reader(io.StringIO(lines))
        header = tuple(next(reader))
        if header != self.columns:
            raise ValueError(
                f"{self.path} must have the columns {', '.join(self.columns)}; it has "
                f"{', '.join(header)}: remove it or choose another folder"
            )
        for number, line in enumerate(reader, start=2):
            try:
                key, record = self._parse(line)
            except ValueError as problem:
                raise ValueError(f"{self.path}, line {number}: {problem}") from problem
            self.rows[key, record.traffic_seed] = record

    def _parse(self, line: list[str]) -> tuple[KeyT, ScoredT]:
        if len(line) != len(self.columns):
            raise ValueError(f"must have {len(self.columns)} values, has {len(line)}")
        values = iter(line)
        key = {name: parse(next(values)) for name, parse in self._key_fields.items()}
        record = {name: parse(next(values)) for name, parse in self._record_fields.items()}
        return self._key_type(**key), self._record_type(**record)

    def lacking(self, key: KeyT, seeds: Iterable[int]) -> tuple[int, ...]:
        """Return the traffic seeds of which a key has no record."""
        return tuple(seed for seed in seeds if (key, seed) not in self.rows)

    def append(self, key: KeyT, records: Iterable[ScoredT]) -> None:
        """Add the records of one task, and put them on disk before returning."""
        records = list(records)
        new = not self.path.exists() or self.path.stat().st_size == 0
        with self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            if new:
                writer.writerow(self.columns)
            writer.writerows(_line(key, record) for record in records)
            file.flush()
            os.fsync(file.fileno())
        self.rows.update({(key, record.traffic_seed): record for record in records})

    def sort(self) -> None:
        """Put the file in an order that does not depend on the course of the run."""
        rows = sorted(
            self.rows.items(), key=lambda item: (*dataclasses.astuple(item[0][0]), item[0][1])
        )
        write_csv(self.path, self.columns, (_line(key, record) for (key, _), record in rows))


def _line(key: Any, record: Any) -> list[Any]:
    return [*dataclasses.astuple(key), *dataclasses.astuple(record)]


def _parsers(cls: type) -> dict[str, type]:
    """Return the type of each field: str, int or float, each of which parses what it prints."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}
