"""The folder of an import: a road file, records, a manifest and a report, all of them or none."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dptse_env.traffic.corridor import Corridor, Recordings
from dptse_env.traffic.demand import Demand
from dptse_env.traffic.imported import load_record, save_record, write_manifest
from dptse_env.traffic.importers.fcd import FCD
from dptse_env.traffic.importers.formats import EXID, HIGHD, NGSIM, TABLE, TGSIM
from dptse_env.traffic.importers.i24 import I24
from dptse_env.traffic.importers.new_folder import new_folder
from dptse_env.traffic.importers.placing import Placer
from dptse_env.traffic.importers.points import Format
from dptse_env.traffic.importers.recording import Options, Recording, Window
from dptse_env.traffic.importers.report import write_report
from dptse_env.traffic.importers.source import Source
from dptse_env.traffic.record import Record, average_dwell
from dptse_env.traffic.road_files import write_corridor
from dptse_env.utils.fields import require, require_name

FORMATS: Mapping[str, Format] = {
    "fcd": FCD(),
    "ngsim": NGSIM,
    "highd": HIGHD,
    "exid": EXID,
    "i24": I24(),
    "tgsim": TGSIM,
    "table": TABLE,
}
"""Formats by name; ``table`` is any table whose columns a `Source` names."""

ROAD = "road.toml"
SMALLEST_SHARE = 0.001
"""Exit shares must be above 0 and below 1: nobody or everybody leaving counts as this much."""


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
    windows of the first split; its incident is dropped.

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
        MissingExtraError: A library that a format needs is not installed.
        OSError: The folder cannot be written.
    """
    require_name("source.format", source.format, FORMATS)
    require(len(files) > 0, "files", "one or more", len(files))
    check_splits(splits)
    bare = dataclasses.replace(
        corridor, incident=None, recordings=None, demand=corridor.published_demand
    )
    with new_folder(output) as folder:
        recordings = _read(files, source, bare, folder.parent, options)
        windows = [(each, window) for each in recordings for window in each.windows]
        seeds = assign_seeds(splits, len(windows))
        flat = [seed for split in splits for seed in seeds[split.name]]
        sources, digests = [], {}
        for seed, (recording, window) in zip(flat, windows, strict=True):
            record = recording.record(window)
            save_record(folder, seed, bare.record_layout, record)
            digests[seed] = record.digest
            sources.append(_describe(seed, recording, window, record))
        digest = write_manifest(folder, bare.record_layout, digests, sources)
        written = Recordings(str(folder), digest)

        def load(seed: int) -> Record:
            return load_record(written, seed, bare.record_layout)

        # One at a time, so that one is in memory.
        measured = measure(bare, lambda: map(load, seeds[splits[0].name]))
        road = dataclasses.replace(measured, recordings=written)
        comment = "Recorded traffic. Demand, exit shares and average dwell are measured."
        write_corridor(folder / ROAD, road, environment, comment)
        report = write_report(folder, road, recordings, seeds, sources, load(flat[0]))
    final = dataclasses.replace(road, recordings=Recordings(str(output.absolute()), digest))
    return Imported(final, seeds, report)


def measure(corridor: Corridor, records: Callable[[], Iterable[Record]]) -> Corridor:
    """Return a corridor with the demand, exit shares and average dwell of records.

    The records are read twice, one after another.

    Flows are Edie's: the mean over time of the sum of speeds over the length of a segment. That of
    the mainline is taken in its first segment, those of ramps in the segment at their face.

    Raises:
        ValueError: No vehicle is on the mainline.
    """
    sums = np.mean([record.speed_sums.mean(axis=0) for record in records()], axis=0)
    flow = sums[: corridor.n_segments] / np.array(corridor.segment_lengths)
    shares = [
        flow[segments[0]] / max(flow[face - 1], 1e-9)
        for face, segments in zip(corridor.off_ramps, corridor.off_ramp_segments, strict=True)
    ]
    entering = [flow[segments[-1]] for segments in corridor.on_ramp_segments]
    held = np.clip(shares, SMALLEST_SHARE, 1.0 - SMALLEST_SHARE)
    return dataclasses.replace(
        corridor,
        demand=Demand(
            mainline=((0.0, round(float(flow[0]), 1)),),
            on_ramps=tuple(round(float(each), 1) for each in entering),
        ),
        exit_shares=tuple(round(float(each), 4) for each in held),
        average_dwell=round(average_dwell(corridor, records()), 3),
    )


def _read(
    files: Sequence[Path], source: Source, corridor: Corridor, work: Path, options: Options
) -> list[Recording]:
    reader = FORMATS[source.format]
    placer = Placer(corridor, source.layout, source.factor("length", reader.units["length"]))
    recordings = []
    for number, path in enumerate(files):
        recording = Recording(path, corridor, source, options, reader, placer)
        recording.read(work / f"file-{number}")
        recordings.append(recording)
    return recordings


def check_splits(splits: Sequence[Split]) -> None:
    """Raise ``ValueError`` unless the shares add up."""
    shares = [split.share for split in splits]
    fits = min(shares) >= 0.0 and shares[0] > 0.0 and abs(sum(shares) - 1.0) < 1e-9
    require(fits, "shares", "at least 0, the first above 0, with the sum 1", shares)


def assign_seeds(splits: Sequence[Split], n_windows: int) -> dict[str, tuple[int, ...]]:
    """Return the traffic seeds of each split: as many as its share says, at least one if it can.

    Raises:
        ValueError: The shares do not add up, or a split has fewer seeds than windows.
    """
    check_splits(splits)
    shares = [split.share for split in splits]
    counts = [0] * len(shares)
    for _ in range(n_windows):
        # The split that is furthest behind its share, those without a window first.
        behind = [
            (share > 0.0 and count == 0, share * n_windows - count)
            for share, count in zip(shares, counts, strict=True)
        ]
        counts[max(range(len(shares)), key=behind.__getitem__)] += 1
    for split, count in zip(splits, counts, strict=True):
        allowed = f"at most {len(split.seeds)} windows of split {split.name}"
        require(count <= len(split.seeds), "files", allowed, count)
    return {
        split.name: tuple(split.seeds[:count]) for split, count in zip(splits, counts, strict=True)
    }


def _describe(seed: int, recording: Recording, window: Window, record: Record) -> dict[str, Any]:
    return {
        "seed": seed,
        "file": recording.path.name,
        "group": window.group,
        "start": window.start,
        "vehicles": len(np.unique(record.vehicle)),
        "rows": record.n_rows,
    }
