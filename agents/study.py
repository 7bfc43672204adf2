"""Studies: cells played on traffic seeds, their rows on disk, and a report made of the rows alone.

The rows of a study stand in ``rows.parquet`` of its folder: a line for each episode, with the
study, the version of the code that played it (`dptse_env.versions`), the cell's id and its labels.
A cell counts as played where the numbers of that version are those of this one; rows that are
played again stand below the ones before.

While a study runs, each finished cell has a file of its own under ``rows/``; they are packed when
all are there, and taken up again after an interruption.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from agents.executors import Executor, run_shown, this_process
from agents.play import Cell, play, record
from agents.tables import are_present, narrow, numbers
from dptse_env.evaluation import WARM_UP
from dptse_env.traffic import Records
from dptse_env.utils.files import write_atomically
from dptse_env.versions import code_version, numbers_of

ROWS, TABLES = "rows.parquet", "tables.md"
"""Files of a study's folder, beside its figures."""

PARTS = "rows"
"""Folder below it of the rows of cells, until all are there."""

DIGITS = 24
"""Hexadecimal digits of the name of a file there."""

OWN = (ROWS, PARTS)
"""Names by which a folder is known to be of a study, which goes on there."""

ORIGIN = ("study", "version", "cell")
"""Columns in front of the labels."""

Report = Callable[[pl.DataFrame, Path], str]
"""Makes Markdown of the rows of a study, and draws figures into its folder."""


class Place(NamedTuple):
    """The folder, executor and records that a study works with.

    Attributes:
        folder: Its results.
        executor: What plays its cells.
        records: Folder of the record cache; None for the user's cache.
    """

    folder: Path
    executor: Executor = this_process
    records: Records = None


Follow = Callable[[pl.DataFrame, Place], Sequence[Cell]]
"""Returns the cells that the rows of other cells ask for, once what they name is there."""


@dataclass(frozen=True)
class Study:
    """A question, as cells and a report.

    Attributes:
        name: Its name, and that of its folder of results.
        cells: What is played.
        seeds: Traffic seeds of every cell that has none of its own.
        report: Makes Markdown of the rows, of whatever version, and draws the figures.
        follow: Returns the cells that the rows of the first ones ask for, such as those of a policy
            that validation has chosen. It may train that policy first.
        measures: Further tables that the report reads, by the name of their file in the folder;
            each is measured once.
    """

    name: str
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    report: Report
    follow: Follow | None = None
    measures: Mapping[str, Callable[[Place], pl.DataFrame]] = field(default_factory=dict)

    def seeds_of(self, cell: Cell) -> tuple[int, ...]:
        """Return the traffic seeds of a cell."""
        return self.seeds if cell.seeds is None else cell.seeds


def run(study: Study, place: Place) -> None:
    """Play what the rows of a study lack, measure what its folder lacks, and write its report.

    Raises:
        ValueError: A cell is out of range, found before the first one is played, or the rows in the
            folder are damaged or of another study.
        RecordingError: Traffic cannot be recorded.
        ExecutorError: Workers died again and again.
        OSError: The folder cannot be written to.
    """
    rows = play_study(study, place)
    if study.follow is not None:
        _play_missing(study, study.follow(rows, place), place)
    for name, measure in study.measures.items():
        if not (place.folder / name).exists():
            write_table(place.folder / name, measure(place))
    write_report(study, place.folder)


def play_study(study: Study, place: Place) -> pl.DataFrame:
    """Play the cells of a study that the rows in a folder lack, and return all of its rows.

    Raises:
        ValueError, RecordingError, ExecutorError, OSError: See `run`.
    """
    _play_missing(study, study.cells, place)
    return read_rows(study.name, place.folder)


def write_report(study: Study, folder: Path) -> None:
    """Write the tables and figures of the rows that a folder has.

    Raises:
        FileNotFoundError: It has none.
        ValueError: They are damaged or of another study.
    """
    rows = read_rows(study.name, folder)
    if rows.is_empty():
        raise FileNotFoundError(f"{folder / ROWS} is not there: run the study without --report")
    write_tables(folder, narrow(study.report(rows, folder).strip()), rows)


def write_tables(folder: Path, content: str, rows: pl.DataFrame) -> None:
    """Write Markdown about some rows, with a last line on where they come from."""
    equal: dict[str, list[str]] = {}
    for version, n in rows.group_by("version").len().sort("version").iter_rows():
        equal.setdefault(numbers_of(version), []).append(f"{version} ({n:,} episodes)")
    versions = ", ".join(map(" = ".join, equal.values()))
    origin = f"Played by dptse-env {versions}. Differences are paired within equal numbers."
    origin += f" Errors leave out the first {WARM_UP} s of an episode."
    write_atomically(folder / TABLES, f"{content}\n\n{origin}\n")


def _play_missing(study: Study, cells: Sequence[Cell], place: Place) -> None:
    """Play the cells that rows of these numbers lack, and pack all rows into one file."""
    rows = read_rows(study.name, place.folder)
    present = are_present(rows)
    played = dict(rows.filter(present).group_by("cell").agg("traffic_seed").iter_rows())
    missing = [
        (cell, study.seeds_of(cell))
        for cell_id, cell in {cell.id: cell for cell in cells}.items()
        if not set(study.seeds_of(cell)) <= set(played.get(cell_id, ()))
    ]
    others = rows.filter(~present, pl.col("cell").is_in([cell.id for cell, _ in missing]))
    if not others.is_empty():
        warnings.warn(
            f"{others['cell'].n_unique()} cells of the study {study.name!r} are played again: "
            f"their rows are by dptse-env {', '.join(others['version'].unique().sort())}, whose "
            f"numbers are not declared equal to those of {code_version()}",
            stacklevel=2,
        )
    for cell, _ in missing:
        cell.check()
    for corridor, seeds in dict.fromkeys((cell.config.corridor, seeds) for cell, seeds in missing):
        record(corridor, seeds, place.records, progress=True)
    folder = place.folder / PARTS
    threads = None if place.executor is this_process else 1
    if missing:
        folder.mkdir(parents=True, exist_ok=True)
    run_shown(
        place.executor,
        partial(_play_cell, study.name, place.records, threads),
        missing,
        lambda index, rows: write_table(_file_of(folder, missing[index][0].id), rows),
        size=lambda task: len(task[1]),
        progress=bool(missing),
        desc=study.name,
        unit="episode",
        mininterval=0.5,
    )
    if folder.is_dir():
        write_table(place.folder / ROWS, read_rows(study.name, place.folder))
        remove_parts(place.folder)


def remove_parts(folder: Path) -> None:
    """Remove the rows of cells from the folder of a study, and nothing that somebody else put."""
    for path in _parts(folder):
        path.unlink()
    with contextlib.suppress(OSError):  # there is none, or it has something of somebody else
        (folder / PARTS).rmdir()


def _play_cell(
    study: str, records: Records, threads: int | None, task: tuple[Cell, tuple[int, ...]]
) -> pl.DataFrame:
    """Play a cell, and return its rows with their origin and its labels.

    Raises:
        ValueError: A label is named like a measured column.
    """
    (cell, seeds), version = task, code_version()  # before an editor changes the code
    rows = play(cell, seeds, records, threads)
    clash = sorted(cell.labels.keys() & {*ORIGIN, *rows[0]})
    if clash:
        raise ValueError(f"labels must differ from the names of columns, got {clash[0]!r}")
    head = dict(zip(ORIGIN, (study, version, cell.id), strict=True))
    rows = [{**head, **cell.labels, **row} for row in rows]
    return pl.DataFrame(rows, infer_schema_length=None)


def _file_of(folder: Path, cell_id: str) -> Path:
    return folder / f"{hashlib.sha256(cell_id.encode()).hexdigest()[:DIGITS]}.parquet"


def _parts(folder: Path) -> list[Path]:
    """Return the files of `_file_of` in the folder of a study."""
    return sorted((folder / PARTS).glob(f"{'[0-9a-f]' * DIGITS}.parquet"))


def read_rows(study: str, folder: Path) -> pl.DataFrame:
    """Return all rows in the folder of a study, those of an interrupted run too.

    Of rows of a cell and a traffic seed by versions of equal numbers it is the last one.

    Raises:
        ValueError: A file is damaged, or of another study.
    """
    keys = (*ORIGIN, "traffic_seed")
    tables = []
    for path in (folder / ROWS, *_parts(folder)):
        if path.exists():
            tables.append(read_table(path, keys))
            others = [name for name in tables[-1]["study"].unique() if name != study]
            if others:
                raise ValueError(
                    f"{path} has rows of the study {others[0]!r}, not of {study!r}: choose another "
                    "--output"
                )
    if not tables:
        return pl.DataFrame(schema={**dict.fromkeys(ORIGIN, pl.String), "traffic_seed": pl.Int64})
    rows: pl.DataFrame = pl.concat(tables, how="diagonal_relaxed")
    kept = rows.select(*keys).with_columns(version=numbers(rows)).with_row_index("row")
    return rows[kept.unique(keys, keep="last", maintain_order=True)["row"]]


def read_table(path: Path, columns: Sequence[str] = ()) -> pl.DataFrame:
    """Return a table with the given columns among its own.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or lacks a column.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there")
    try:
        table = pl.read_parquet(path.read_bytes())  # its name would be a pattern
    except (pl.exceptions.PolarsError, OSError) as problem:
        reason = str(problem).splitlines()[0]
        raise ValueError(f"{path} is not a table that this program wrote: {reason}") from problem
    lacking = [name for name in columns if name not in table.columns]
    if lacking:
        raise ValueError(f"{path} must have a column {lacking[0]!r}, has {table.columns}")
    return table


def write_table(path: Path, table: pl.DataFrame) -> None:
    """Write a table in one piece, compressed.

    Raises:
        OSError: It cannot be written; the old one stays.
    """
    content = io.BytesIO()  # polars has an error of its own for a full disk
    table.write_parquet(content, compression="zstd", compression_level=19)
    write_atomically(path, content.getvalue())
