"""Folder of an import: road file, records, manifest and report, which appear together."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import itertools
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from filelock import FileLock, Timeout

from dptse_env.importers.measured import measure
from dptse_env.importers.placing import Branches
from dptse_env.importers.recording import Options, Recording
from dptse_env.importers.report import write_report
from dptse_env.importers.source import Source
from dptse_env.importers.tables import FORMATS
from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.imported import load_record, ranges, save_records
from dptse_env.traffic.record import Record
from dptse_env.traffic.roads import road_name, write_corridor
from dptse_env.utils.files import hidden, left_hidden, require_output
from dptse_env.utils.validation import require, require_name

ROAD = "road.toml"
LOCK = ".lock"
"""File that a process holds while it makes a folder."""
NO_SPACE = 2**16
"""Free space below which a disk is full [bytes]."""
DATES = 1e8
"""Times above are counted from a date [s], and not from the start of a file."""


class Split(NamedTuple):
    """A part of the windows, one after another in time.

    Attributes:
        name: Such as ``training``.
        share: Its share of the windows.
        seeds: Traffic seeds that its windows get, from the first on.
    """

    name: str
    share: float
    seeds: range


@dataclass(frozen=True)
class Imported:
    """An import that is complete.

    Attributes:
        corridor: The road, with its recordings.
        seeds: Traffic seeds by name of the split.
        report: What the report says, as plain JSON.
    """

    corridor: Corridor
    seeds: Mapping[str, tuple[int, ...]]
    report: Mapping[str, Any]


def import_trajectories(
    files: Sequence[Path],
    source: Source,
    corridor: Corridor,
    output: Path,
    splits: Sequence[Split],
    options: Options = Options(),  # noqa: B008 (frozen)
    environment: Mapping[str, Any] | None = None,
) -> Imported:
    """Import files of trajectories as records of a corridor.

    Each file is cut into windows of `corridor.duration` seconds (that many, and the second 0),
    which do not overlap. Windows are in the order of the files and of time; the first are those of
    the first split. Demand, exit shares and average dwell of the written road are measured in the
    windows of the first split that has any; its incident is dropped.

    Args:
        files: The files, in order of time.
        source: What they mean.
        corridor: The road that they are on.
        output: Folder to create. It appears when it is complete.
        splits: Parts of the windows.
        options: How trajectories are cut.
        environment: Keywords for the road file's table ``environment``.

    Raises:
        ValueError: An argument is out of range, the folder exists, or a file cannot be imported
            (`TrajectoryError`); the message has its path, and the row where there is one.
        OSError: The folder cannot be written.
    """
    require_name("source.format", source.format, FORMATS)
    require(len(files) > 0, "files", "one or more", len(files))
    once = len({path.resolve() for path in files}) == len(files)
    require(once, "files", "given once each", [str(path) for path in files])
    check_splits(splits)
    bare = corridor.replaced(
        incident=None, recordings=None, demand=corridor.conditions.published_demand
    )
    with new_folder(output) as folder:
        recordings = [
            Recording(path, Branches(bare), source, options, folder.parent / f"file-{number}")
            for number, path in enumerate(files)
        ]
        windows = [(each, row) for each in recordings for row in each.windows.iter_rows(named=True)]
        seeds = assign_seeds(splits, len(windows))
        flat = [seed for split in splits for seed in seeds[split.name]]
        sources: list[dict[str, Any]] = [
            {"seed": seed, "file": recording.path.name, "group": window["group"],
             "start": window["start"]}
            for seed, (recording, window) in zip(flat, windows, strict=True)
        ]  # fmt: skip

        used, empty = np.zeros(bare.geometry.n_cells, dtype=bool), list[int]()

        def records() -> Iterator[Record]:
            for source_of, (recording, window) in zip(sources, windows, strict=True):
                record = recording.record(window["window"])
                source_of |= {"vehicles": len(np.unique(record.vehicle)), "rows": record.n_rows}
                used[:] |= record.counts.any(axis=0)
                empty.extend(
                    [source_of["seed"]] * (not record.counts[0, : bare.geometry.n_mainline].any())
                )
                yield record

        recorded = bare.replaced(recordings=save_records(folder, bare, records(), sources))
        notes = [
            f"no vehicle is ever on the {kind}-ramp at face {face}"
            for kind, faces, ramps in (
                ("on", bare.geometry.on_ramps, bare.geometry.on_ramp_segments),
                ("off", bare.geometry.off_ramps, bare.geometry.off_ramp_segments),
            )
            for face, segments in zip(faces, ramps, strict=True)
            if not used[list(segments)].any()
        ]
        if empty:
            notes.append(f"windows begin on an empty mainline: traffic seeds {ranges(empty)}")
        notes += _overlaps(sources, corridor.conditions.duration)

        # One at a time, so that one is in memory.
        first = next(filter(None, seeds.values()))
        road = measure(recorded, lambda: (load_record(recorded, seed) for seed in first))
        comment = "Recorded traffic. Demand, exit shares and average dwell are measured."
        write_corridor(folder / ROAD, road, environment, comment)
        drawn = load_record(recorded, flat[0])
        report = write_report(folder, road, recordings, seeds, sources, drawn, notes)
    return Imported(moved(road, output), seeds, report)


def named_after(output: Path) -> str:
    """Return the name of a road that is that of its folder.

    Raises:
        ValueError: It has no letter and no digit.
    """
    name = road_name(output.absolute().name)
    allowed = "a folder whose name, which the road gets, has letters a to z or digits"
    require(name != "", "output", allowed, str(output))
    return name


def require_new(output: Path) -> None:
    """Refuse a folder that is there, or cannot be made.

    Raises:
        ValueError: It is so.
    """
    require(output.name != "", "output", "a folder with a name", str(output))
    require_output(output.parent, [output.name])


def moved(road: Corridor, output: Path) -> Corridor:
    """Return a road whose recordings are in another folder."""
    assert road.recordings is not None
    there = dataclasses.replace(road.recordings, folder=str(output.absolute()))
    return road.replaced(recordings=there)


def _overlaps(windows: Iterable[Mapping[str, Any]], duration: float) -> list[str]:
    """Return a note on the first windows [s] of two files that are at one time, by their dates."""
    in_order = sorted(windows, key=lambda each: (each["group"], each["start"]))
    for one, other in itertools.pairwise(in_order):
        same = one["group"] == other["group"] and one["file"] != other["file"]
        if same and DATES < other["start"] <= one["start"] + duration:
            return [
                f"{one['file']} and {other['file']} overlap in time, from {other['start']:.10g} s "
                "on: the same vehicles may be in windows of both"
            ]
    return []


def check_splits(splits: Sequence[Split]) -> None:
    """Raise ``ValueError`` unless the shares add up."""
    shares = [split.share for split in splits]
    fits = min(shares) >= 0.0 and abs(sum(shares) - 1.0) < 1e-9
    require(fits, "shares", "at least 0, with the sum 1", shares)


def assign_seeds(splits: Sequence[Split], n_windows: int) -> dict[str, tuple[int, ...]]:
    """Return the traffic seeds of each split: as many as its share says, at least one if it can.

    Raises:
        ValueError: The shares do not add up, or a split has fewer seeds than windows.
    """
    check_splits(splits)
    counts = [0] * len(splits)
    for _ in range(n_windows):
        # The split that is furthest behind its share, those without a window first.
        behind = [
            (split.share > 0.0 and count == 0, split.share * n_windows - count)
            for split, count in zip(splits, counts, strict=True)
        ]
        counts[max(range(len(splits)), key=behind.__getitem__)] += 1
    for split, count in zip(splits, counts, strict=True):
        allowed = f"at most {len(split.seeds)} windows of split {split.name}"
        require(count <= len(split.seeds), "files", allowed, count)
    return {s.name: tuple(s.seeds[:count]) for s, count in zip(splits, counts, strict=True)}


@contextlib.contextmanager
def new_folder(output: Path) -> Iterator[Path]:
    """Yield an empty folder that becomes `output` when the body ends, and vanishes if it fails.

    Its parent is a folder for this alone, in which the body may leave what is thrown away. That of
    a process that was killed goes, too.

    Raises:
        ValueError: There is something at `output`, it cannot be written, or another process makes
            it.
        OSError: The disk is full.
    """
    require_new(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    work = hidden(output.absolute())
    for left in left_hidden(output):
        _remove_left(left, output)
    folder = work / "result"
    folder.mkdir(parents=True)
    try:
        with FileLock(work / LOCK):
            yield folder
            folder.rename(output)
    except Exception as problem:
        # Whatever else is said then, such as that a file of ours which was cut off is malformed.
        if shutil.disk_usage(work).free < NO_SPACE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(output)) from problem
        raise
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _remove_left(work: Path, output: Path) -> None:
    """Remove what a process that was killed has left; refuse what one still works in."""
    try:
        with FileLock(work / LOCK, timeout=0):
            pass
    except Timeout as held:
        raise ValueError(
            f"output must be made by one process at a time, got {output}, which another one makes"
        ) from held
    except OSError:  # another user's
        return
    shutil.rmtree(work, ignore_errors=True)
