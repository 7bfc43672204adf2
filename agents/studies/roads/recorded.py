"""Roads with recordings that are made when they are first used, in the user's cache.

A configuration names them by this module: ``"agents.studies.roads.recorded:idm"``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock

from agents.studies.roads import idm as simulator
from dptse_env.importers.folder import ROAD, measure, new_folder, save_records
from dptse_env.traffic import Corridor, read_corridor, write_corridor
from dptse_env.traffic.library import default_path
from dptse_env.utils.files import file_digest

IDM_SEEDS = tuple(range(2000, 2016))


def idm() -> Corridor:
    """Return the road of the other simulator, with `IDM_SEEDS`."""

    def write(folder: Path) -> None:
        records = [simulator.simulate(seed) for seed in IDM_SEEDS]
        road = measure(simulator.road(), lambda: records)
        sources = [{"seed": seed} for seed in IDM_SEEDS]
        kept = save_records(folder, road, records, sources)
        write_corridor(folder / ROAD, dataclasses.replace(road, recordings=kept))

    return _made_once(f"idm-{file_digest(simulator.__file__)[:16]}", write)


def _made_once(name: str, write: Callable[[Path], None]) -> Corridor:
    """Return the road of a folder in the cache, which is written if it is not there."""
    folder = default_path() / "roads" / name
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.parent / f".{name}.lock"):
            if not folder.exists():
                with new_folder(folder) as empty:
                    write(empty)
    return read_corridor(folder / ROAD)
