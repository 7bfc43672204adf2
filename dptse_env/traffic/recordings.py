"""Recorded traffic: a folder of records that were imported from trajectories, not simulated.

Such records cannot be made again, so nothing here replaces one: what is missing, damaged or
exchanged is an error. `dptse_env.importers` writes the folder.
"""

import functools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dptse_env.traffic.field_record import AnyRecord, load_record
from dptse_env.traffic.stored_arrays import MANIFEST, InvalidRecordError
from dptse_env.utils.digests import json_digest
from dptse_env.utils.fields import checked_fields, integer, parse_object

RECORDINGS_FORMAT = "dptse-recordings"
RECORDINGS_VERSION = 1
RECORDS = "records"
"""Folder of the records in a folder of recordings."""

Kind = Literal["vehicles", "fields"]
"""Kind of the records of a folder."""

_KEYS = {"format": str, "version": int, "kind": str, "road": dict, "records": dict, "sources": list}


@dataclass(frozen=True)
class Recordings:
    """A folder of records of real or foreign traffic, one for each traffic seed that it has.

    Attributes:
        folder: the folder; in a road file it may be relative to that file.
        digest: SHA-256 (hex) of the checksums of all records and of the road that they are made
            for, from the folder's manifest.
    """

    folder: str
    digest: str

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "corridor.recordings")

    @property
    def seeds(self) -> tuple[int, ...]:
        """Traffic seeds that there are records of, ascending.

        Raises:
            InvalidRecordError: The manifest is missing, damaged, or not that of the digest.
        """
        return tuple(sorted(map(int, _manifest(self)["records"])))

    @property
    def has_vehicles(self) -> bool:
        """True if the records have vehicles; measured fields have none."""
        return bool(_manifest(self)["kind"] == "vehicles")

    def require(self, seeds: Iterable[int]) -> None:
        """Raise ``ValueError`` unless there is a record of each of `seeds`."""
        known = self.seeds
        lacking = sorted(set(seeds) - set(known))
        if lacking:
            raise ValueError(
                f"traffic seed must be one that was recorded ({ranges(known)} in {self.folder}), "
                f"got {ranges(lacking)}"
            )

    def record_path(self, seed: int) -> Path:
        """Return the folder of a record, whether it exists or not."""
        return record_path(Path(self.folder), seed)

    def load(self, seed: int, road: Mapping[str, Any]) -> AnyRecord:
        """Open the record of a traffic seed.

        Args:
            seed: The traffic seed.
            road: What the records must be made for: `Corridor.record_layout`.

        Raises:
            ValueError: There is no record of the seed.
            InvalidRecordError: The record is damaged or another one, or made for another road.
        """
        self.require([integer("traffic seed", seed, 0)])
        manifest, path = _manifest(self), self.record_path(seed)
        if manifest["road"] != road:
            differing = [key for key in road if manifest["road"].get(key) != road[key]]
            raise InvalidRecordError(
                f"{self.folder} was recorded on a road with other {', '.join(differing)} than the "
                f"corridor's: import the trajectories again for this corridor"
            )
        try:
            record = load_record(path, record_source(seed, road))
            found = json.loads((path / MANIFEST).read_text(encoding="utf-8"))["sha256"]
        except FileNotFoundError as problem:
            raise InvalidRecordError(f"{path}: the record is missing") from problem
        if found != manifest["records"][str(seed)]:
            raise InvalidRecordError(f"{path}: it is not the record that was imported")
        return record


def record_path(folder: Path, seed: int) -> Path:
    """Return the folder of a record in a folder of recordings, whether it exists or not."""
    return folder / RECORDS / f"{seed:08d}"


def record_source(seed: int, road: Mapping[str, Any]) -> dict[str, object]:
    """Return the description that is saved with an imported record; see `Record.save`."""
    return {"recorded": True, "seed": seed, "road": dict(road)}


def write_manifest(
    folder: Path,
    road: Mapping[str, Any],
    seeds: Iterable[int],
    sources: list[dict[str, Any]],
    kind: Kind = "vehicles",
) -> str:
    """Write the manifest of a folder whose records are complete; return its digest.

    Args:
        folder: The folder of the recordings.
        road: `Corridor.record_layout` of the road that they are made for.
        seeds: Their traffic seeds.
        sources: JSON descriptions of the windows that they were cut from, for the reader.
        kind: Whether the records have vehicles or are measured fields.
    """
    paths = {seed: record_path(folder, seed) / MANIFEST for seed in seeds}
    checksums = {
        str(seed): json.loads(path.read_text(encoding="utf-8"))["sha256"]
        for seed, path in paths.items()
    }
    manifest = {
        "format": RECORDINGS_FORMAT,
        "version": RECORDINGS_VERSION,
        "kind": kind,
        "road": dict(road),
        "records": checksums,
        "sources": sources,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return _digest(manifest)


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
        manifest = parse_object(path.read_bytes(), str(path), _KEYS)
    except OSError as problem:
        message = f"{path}: recordings cannot be read: {problem.strerror}"
        raise InvalidRecordError(message) from problem
    except ValueError as problem:
        raise InvalidRecordError(str(problem)) from problem
    wanted = RECORDINGS_FORMAT, RECORDINGS_VERSION
    if (manifest["format"], manifest["version"]) != wanted:
        raise InvalidRecordError(
            f"{path}: format must be {wanted}, got {manifest['format'], manifest['version']}"
        )
    if _digest(manifest) != recordings.digest:
        raise InvalidRecordError(
            f"{path}: it is not the manifest of corridor.recordings.digest {recordings.digest!r}"
        )
    return manifest


def _digest(manifest: Mapping[str, Any]) -> str:
    content = {key: manifest[key] for key in ("format", "version", "kind", "road", "records")}
    return json_digest(content)
