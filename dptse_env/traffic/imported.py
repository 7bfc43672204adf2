"""Folders of imported records: real or foreign traffic, not simulated.

Such records cannot be made again, so nothing here replaces one: what is missing, damaged or
exchanged is an error. Importers write the folder, and a corridor names it (`Recordings`).
"""

import functools
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from dptse_env.traffic.corridor import Corridor, Recordings
from dptse_env.traffic.record import InvalidRecordError, Record
from dptse_env.utils.files import json_digest
from dptse_env.utils.validation import check_object, integer, parse_json

MANIFEST = "manifest.json"
FORMAT = "dptse-recordings"
VERSION = 2

LARGEST_MANIFEST = 10_000_000
"""Largest size of a manifest [bytes]."""

Kind = Literal["vehicles", "fields"]
"""Kind of the records of a folder."""

_KEYS = {"format": str, "version": int, "kind": str, "road": dict, "records": dict, "sources": list}


def record_path(folder: str | Path, seed: int) -> Path:
    """Return the path of a record in a folder of recordings, whether it exists or not."""
    return Path(folder) / "records" / f"{seed:08d}.safetensors"


def save_records(
    folder: Path,
    corridor: Corridor,
    records: Iterable[Record],
    sources: list[dict[str, Any]],
    kind: Kind = "vehicles",
) -> Recordings:
    """Write records to a folder, one after another, and then its manifest.

    Args:
        folder: The folder.
        corridor: The road that they are made for.
        records: A record for each source; each is asked for when the last one is written.
        sources: A JSON description of each window, with its traffic ``seed``.
        kind: Whether the records have vehicles or are measured fields.

    Raises:
        OSError: The folder cannot be written.
    """
    digests = {}
    for source, record in zip(sources, records, strict=True):
        seed = source["seed"]
        record.save(record_path(folder, seed), _source(seed, corridor))
        digests[str(seed)] = record.digest
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "kind": kind,
        "road": _layout(corridor),
        "records": digests,
        "sources": sources,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return Recordings(str(folder), _digest(manifest))


def recorded_seeds(recordings: Recordings) -> tuple[int, ...]:
    """Return the traffic seeds that there are records of, ascending.

    Raises:
        InvalidRecordError: The manifest is missing, damaged, or not that of the digest.
    """
    return tuple(sorted(map(int, _manifest(recordings)["records"])))


def has_vehicles(recordings: Recordings | None) -> bool:
    """Return whether the records have vehicles, as simulated ones do; may raise as above."""
    return recordings is None or bool(_manifest(recordings)["kind"] == "vehicles")


def require_seeds(recordings: Recordings, seeds: Iterable[int], path: str = "traffic seed") -> None:
    """Raise ``ValueError``, with the path of the seeds, unless there is a record of each."""
    known = recorded_seeds(recordings)
    lacking = sorted(set(seeds) - set(known))
    if lacking:
        raise ValueError(
            f"{path} must be one that was recorded ({ranges(known):.200} in "
            f"{recordings.folder}), got {ranges(lacking):.200}"
        )


def load_record(corridor: Corridor, seed: int) -> Record:
    """Read the record of a traffic seed.

    Args:
        corridor: A road with recordings, which must be made for it.
        seed: The traffic seed.

    Raises:
        ValueError: There is no record of the seed.
        InvalidRecordError: The record is damaged or another one, or made for another road.
    """
    recordings = corridor.recordings
    assert recordings is not None
    require_seeds(recordings, [integer("traffic seed", seed, 0)])
    manifest, path = _manifest(recordings), record_path(recordings.folder, seed)
    road = _layout(corridor)
    if manifest["road"] != road:
        differing = [key for key in road if manifest["road"].get(key) != road[key]]
        raise InvalidRecordError(
            f"{recordings.folder} was recorded on a road with other {', '.join(differing)} than "
            f"the corridor's: import the trajectories again for this corridor"
        )
    try:
        record = Record.load(path, _source(seed, corridor), corridor.record_shape)
    except FileNotFoundError as problem:
        raise InvalidRecordError(f"{path}: the record is missing") from problem
    if record.digest != manifest["records"][str(seed)]:
        raise InvalidRecordError(f"{path}: it is not the record that was imported")
    return record


def ranges(seeds: Iterable[int]) -> str:
    """Return integers as text, neighbours together: ``0..3, 7``; ``none`` if there are none."""
    found: list[list[int]] = []
    for seed in sorted(seeds):
        if found and seed == found[-1][1] + 1:
            found[-1][1] = seed
        else:
            found.append([seed, seed])
    return ", ".join(str(a) if a == b else f"{a}..{b}" for a, b in found) or "none"


@functools.lru_cache(maxsize=64)
def _manifest(recordings: Recordings) -> dict[str, Any]:
    """Read a manifest and hold it to the digest; what was read once need not be read again."""
    path = Path(recordings.folder) / MANIFEST
    try:
        if path.stat().st_size > LARGEST_MANIFEST:
            raise InvalidRecordError(f"{path} must have at most {LARGEST_MANIFEST} bytes")
        content = parse_json(path.read_bytes(), str(path))
        manifest = check_object(content, str(path), _KEYS)
    except OSError as problem:
        message = f"{path}: recordings cannot be read: {problem.strerror}"
        raise InvalidRecordError(message) from problem
    except ValueError as problem:
        raise InvalidRecordError(str(problem)) from problem
    found = manifest["format"], manifest["version"]
    if found != (FORMAT, VERSION):
        raise InvalidRecordError(f"{path}: format must be {(FORMAT, VERSION)}, got {found!r:.100}")
    if _digest(manifest) != recordings.digest:
        raise InvalidRecordError(
            f"{path}: it is not the manifest of corridor.recordings.digest "
            f"{recordings.digest!r:.100}"
        )
    for seed in manifest["records"]:
        if not (seed.isdecimal() and len(seed) < 19):
            raise InvalidRecordError(f"{path}: records must have traffic seeds, got {seed!r:.100}")
    return manifest


def _digest(manifest: Mapping[str, Any]) -> str:
    content = {key: manifest[key] for key in ("format", "version", "kind", "road", "records")}
    return json_digest(content)


def _layout(corridor: Corridor) -> dict[str, Any]:
    """Return the fields that the columns and the length of a record depend on, as plain JSON."""
    road = corridor.geometry
    return {
        "n_mainline": road.n_mainline,
        "on_ramps": list(road.on_ramps),
        "off_ramps": list(road.off_ramps),
        "ramp_segments": [len(segments) for _, _, segments in road.ramps()],
        "segment_lengths": list(road.segment_lengths),
        "duration": corridor.conditions.duration,
    }


def _source(seed: int, corridor: Corridor) -> dict[str, object]:
    return {"recorded": True, "seed": seed, "road": _layout(corridor)}
