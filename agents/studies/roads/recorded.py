"""Sections of highways, recorded in the user's cache when they are first used.

A configuration names them by this module, as ``"agents.studies.roads.recorded:section_10003"`` or
``"agents.studies.roads.recorded:lorries_10000"``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from filelock import FileLock

from agents.filters import sections
from agents.filters.highways import KINDS, Highway, draw_highway
from agents.filters.highways import Kind as HighwayKind
from agents.filters.sections import Section
from dptse_env.importers.folder import ROAD, new_folder
from dptse_env.traffic import Corridor, RecordLibrary, read_corridor, write_corridor
from dptse_env.traffic.imported import load_record, save_records
from dptse_env.traffic.library import CACHE_VARIABLE, default_path
from dptse_env.utils.files import file_digest, json_digest, require_writable

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


TRAINING, TEST = (0, 1, 2), tuple(range(2000, 2012))
"""Traffic seeds of drawn roads: those that parameters of filters are fitted to, and the study's."""
SECONDS = 500
"""Length of their episodes [s]."""


def __getattr__(name: str) -> Callable[[], Corridor]:
    """Return what makes the road ``<kind>_<number>``; ``section`` is a section with queues."""
    kind, _, number = name.partition("_")
    makers: dict[str, Callable[[int], Corridor]] = {"section": section}
    makers |= {each: partial(drawn, each) for each in KINDS[1:]}
    if kind not in makers or not number.isdecimal():
        raise AttributeError(f"{__name__} has no {name!r}")
    return partial(makers[kind], int(number))


def section(number: int) -> Corridor:
    """Return a section of a highway, whose record has the highway's number as its traffic seed."""
    return _kept(f"section-{number}", draw_highway(number), partial(_write_section, number))


def drawn(kind: HighwayKind, number: int) -> Corridor:
    """Return a highway of another kind, but for its ends, with records of all its seeds."""
    write = partial(_write_drawn, kind, number)
    return _kept(f"{kind}-{number}", draw_highway(number, kind), write)


def _kept(name: str, highway: Highway, write: Callable[[Path], None]) -> Corridor:
    """Return the road of a folder in the cache, which is written when it is first used."""
    made_of = [highway.corridor.digest, highway.limit, file_digest(str(sections.__file__))]
    name = f"{name}-{json_digest(made_of)[:16]}"
    folder = default_path() / "roads" / name
    if not folder.exists():
        require_writable(CACHE_VARIABLE, default_path())
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.parent / f".{name}.lock"):
            if not folder.exists():
                with new_folder(folder) as empty:
                    write(empty)
    return read_corridor(folder / ROAD)


def _write_section(number: int, folder: Path) -> None:
    with tempfile.TemporaryDirectory() as work:
        cut = Section(number, segments=9, windows=1, seconds=400)
        road = read_corridor(cut.write(Path(work), RecordLibrary()))
        record = load_record(road, 0)
    kept = save_records(folder, road, [record], [{"seed": number}])
    write_corridor(folder / ROAD, road.replaced(recordings=kept))


def _write_drawn(kind: HighwayKind, number: int, folder: Path) -> None:
    segments, seeds = draw_highway(number, kind).corridor.geometry.n_mainline - 2, TRAINING + TEST
    Section(number, segments, len(seeds), SECONDS, kind=kind, traffic=seeds).write(
        folder, RecordLibrary()
    )
