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
from agents.filters.highways import Section
from dptse_env.importers.folder import ROAD, new_folder
from dptse_env.traffic import Corridor, RecordLibrary, read_corridor, write_corridor
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
"""Numbers of highways whose sections are played, by where they have a queue.

A segment with a queue is slow in 15 % of the seconds or more, others at the end and all where there
is no queue in less than 2 %. Weights are trained on highways of smaller numbers.
"""


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
        cut = Section(number, segments=9, windows=1, seconds=400)
        road = read_corridor(cut.write(Path(work), RecordLibrary()))
        record = load_record(road, 0)
    kept = save_records(folder, road, [record], [{"seed": number}])
    write_corridor(folder / ROAD, road.replaced(recordings=kept))
