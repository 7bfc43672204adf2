"""Sections of highways, recorded in the user's cache when they are first used.

A configuration names them by this module, as ``"agents.studies.roads.recorded:section_10003"``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from filelock import FileLock

from agents.filters import highways
from agents.filters.highways import SLOW, Section
from dptse_env.importers.folder import ROAD, new_folder
from dptse_env.traffic import Corridor, Record, RecordLibrary, read_corridor, write_corridor
from dptse_env.traffic.imported import load_record, save_records
from dptse_env.traffic.library import CACHE_VARIABLE, default_path
from dptse_env.utils.files import file_digest, require_writable

QUEUES: dict[str, tuple[int, ...]] = {
    "queue through the end": (
        10002, 10003, 10004, 10006, 10007, 10008, 10011, 10013, 10014, 10015,
    ),
    "queue inside": (
        10001, 10005, 10010, 10012, 10016, 10038, 10040, 10044, 10045, 10050,
    ),
    "no queue": (
        10000, 10017, 10021, 10022, 10023, 10027, 10028, 10035, 10043, 10046,
    ),
}  # fmt: skip
"""Numbers of highways whose sections are played, by where they have a queue, as `queue_of` finds
it. Weights are trained on highways of smaller numbers."""
SEGMENTS, SECONDS = 9, 400
"""Segments of a section, and seconds of its record."""
QUEUED, RARELY = 0.15, 0.02
"""Shares of the seconds in which a segment with a queue, and one without, is slow."""


def __getattr__(name: str) -> Callable[[], Corridor]:
    """Return what makes the section ``section_<number>``."""
    kind, _, number = name.partition("_")
    if kind != "section" or not number.isdecimal():
        raise AttributeError(f"{__name__} has no {name!r}")
    return partial(section, int(number))


def section(number: int) -> Corridor:
    """Return a section of a highway, whose record has the highway's number as its traffic seed."""
    name = f"section-{number}-{file_digest(highways.__file__)[:16]}"
    folder = default_path() / "roads" / name
    if not folder.exists():
        require_writable(CACHE_VARIABLE, default_path())
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.parent / f".{name}.lock"):
            if not folder.exists():
                with new_folder(folder) as empty:
                    _write_section(number, empty)
    return read_corridor(folder / ROAD)


def _write_section(number: int, folder: Path) -> None:
    with tempfile.TemporaryDirectory() as work:
        cut = Section(number, SEGMENTS, windows=1, seconds=SECONDS)
        road = read_corridor(cut.write(Path(work), RecordLibrary()))
        record = load_record(road, 0)
    kept = save_records(folder, road, [record], [{"seed": number}])
    write_corridor(folder / ROAD, road.replaced(recordings=kept))


def queue_of(road: Corridor, record: Record) -> str | None:
    """Return where a section has a queue, one of `QUEUES`; None where that is not clear."""
    lengths, limits = road.road.lengths, road.road.limits
    slow = (record.traffic(lengths, limits)[..., 1] < SLOW * limits).mean(axis=0)
    mainline, (start, end) = slow[: road.geometry.n_mainline], slow[road.geometry.n_segments :][:2]
    if min(mainline[-1], end) > QUEUED:
        return "queue through the end"
    if mainline.max() > QUEUED and end < RARELY:
        return "queue inside"
    return "no queue" if max(*mainline, start, end) < RARELY else None
