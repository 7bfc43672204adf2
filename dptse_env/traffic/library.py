"""The library of records on disk: each scenario is recorded once and then only read.

A record is found by the corridor's digest, the traffic seed, SUMO's version and the record format;
when any of them changes, another record is made. Several processes may use a library at once.

The library decides by the corridor how a record comes to be: that of a corridor with recordings is
read from their folder and never made, any other is read, or else simulated.

A record appears under its name when it is complete, so a writer that is killed leaves a hidden
file at most. Its writer may still run, perhaps on another machine, so such a file is removed when
it has reached a certain age.
"""

import contextlib
import logging
import math
import multiprocessing
import os
import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import platformdirs

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.imported import load_record, ranges, record_path, require_seeds
from dptse_env.traffic.own_sumo import WARNING
from dptse_env.traffic.record import RECORD_VERSION, InvalidRecordError, Record
from dptse_env.traffic.recording import record_seeds
from dptse_env.traffic.sumo import RecordingError
from dptse_env.traffic.sumo_input import NetconvertError
from dptse_env.utils.files import require_writable
from dptse_env.utils.progress import make_bar
from dptse_env.utils.threads import n_cores
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import integer, require
from dptse_env.versions import TESTED_SUMO, SumoVersionError, release, sumo_version

CACHE_VARIABLE = "DPTSE_CACHE"
"""Environment variable with the directory of the records; errors name it."""

IN_MEMORY = 2**28
"""Size of the records that a library keeps in memory [bytes], if nothing else is said."""

LEFTOVER_AGE = 6 * HOUR
"""Age [s] at which a hidden file is considered abandoned. Writing takes a second."""

RECORDED = 2000.0
"""Length of road [km] times duration [s] that SUMO records in a second, roughly."""

LONG = 3.0
"""Time of a recording [s] from which on it is announced."""

logger = logging.getLogger(__name__)

_said: set[str] = set()
"""Digests of the roads whose recording this process has announced."""


def default_path() -> Path:
    """Return the directory named by ``DPTSE_CACHE``, or else the user's cache directory."""
    configured = os.environ.get(CACHE_VARIABLE)
    if not configured:
        return platformdirs.user_cache_path("dptse-env")
    return Path(configured).expanduser()  # a shell does so, containers and services do not


class RecordLibrary:
    """Records by corridor and traffic seed, made on first use.

    Args:
        path: the library's directory; created when the first record is written. Default:
            `default_path`.
        memory: size of the records kept in memory [bytes], at least the one read last; reading one
            again takes a few milliseconds.

    Raises:
        ValueError: `memory` is negative.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, memory: int = IN_MEMORY) -> None:
        """Store the path; nothing is read or written yet."""
        self.is_default = path is None
        self.path = default_path() if path is None else Path(path).expanduser()
        self.memory = integer("library.memory", memory, 0)
        self._kept: OrderedDict[tuple[str, int], Record] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type["RecordLibrary"], tuple[Any, ...]]:
        """Pickle as the path alone: each process reads the records itself.

        The default path is found anew, as another machine may have another one.
        """
        return type(self), (None if self.is_default else self.path, self.memory)

    def get(self, corridor: Corridor, seed: int) -> Record:
        """Return the record of a traffic seed, which is made now if it is missing or damaged.

        Raises:
            ValueError: The seed is negative or no integer, or was not recorded.
            InvalidRecordError: A record of the corridor's recordings is damaged or exchanged.
            RecordingError: The record cannot be made; the message names the library and the seed.
            NetconvertError: The corridor has to be compiled and cannot be.
            SumoVersionError: libsumo is missing, broken or too old.
        """
        seed = integer("traffic seed", seed, 0)
        key = corridor.digest, seed
        with self._lock:
            record = self._kept.pop(key, None)
            if record is None:
                with self._explained_errors(corridor, [seed]):
                    record = self._load_or_record(corridor, seed)
            self._kept[key] = record
            while len(self._kept) > 1 and sum(r.n_bytes for r in self._kept.values()) > self.memory:
                self._kept.popitem(last=False)
            return record

    def missing(self, corridor: Corridor, seeds: Iterable[int]) -> list[int]:
        """Return those of `seeds` that have no record yet, each once and in the order given.

        Nothing is opened: a damaged record counts as present, and `get` makes it again.

        Raises:
            ValueError: A seed is negative or no integer, or was not recorded.
            SumoVersionError: libsumo is missing or too old.
        """
        wanted = dict.fromkeys(integer("traffic seed", seed, 0) for seed in seeds)
        if corridor.recordings is not None:
            require_seeds(corridor.recordings, wanted)
        return [seed for seed in wanted if not self.record_path(corridor, seed).is_file()]

    def ensure(
        self,
        corridor: Corridor,
        seeds: Iterable[int],
        workers: int | None = None,
        progress: bool = False,
    ) -> None:
        """Make the missing records of `seeds`, several at once; imported ones cannot be made.

        The default number of `workers` is that of usable cores; `progress` shows a progress bar.

        Raises:
            ValueError: A seed or the number of workers is out of range, or a seed was not recorded.
            RecordingError: A recording fails; the message names its seed and the number of records
                in the library. Recordings in progress are finished and kept, no other is started.
            NetconvertError: The corridor has to be compiled and cannot be.
            SumoVersionError: libsumo is missing, broken or too old.
        """
        n_workers = n_cores() if workers is None else integer("workers", workers, 1)
        wanted = list(dict.fromkeys(integer("traffic seed", seed, 0) for seed in seeds))
        with self._explained_errors(corridor, wanted):
            missing = self.missing(corridor, wanted)
            if missing and corridor.recordings is None:
                self._record(corridor, missing, n_workers, progress)

    def record_path(self, corridor: Corridor, seed: int) -> Path:
        """Return the file of a record, whether it exists or not."""
        if corridor.recordings is not None:
            return record_path(corridor.recordings.folder, seed)
        folder = f"records-v{RECORD_VERSION}-sumo-{_used_version()}"
        return self.path / folder / corridor.digest[:32] / f"{seed:08d}.safetensors"

    def prepare(self, corridor: Corridor, seed: int) -> Path:
        """Make the folder of a record that is going to be written, and return it.

        Abandoned records in it are removed.

        Raises:
            RecordingError: It cannot be made or written to.
        """
        folder = self.record_path(corridor, seed).parent
        try:
            require_writable(CACHE_VARIABLE if self.is_default else "records", folder)
            folder.mkdir(parents=True, exist_ok=True)
        except (ValueError, OSError) as error:
            raise RecordingError.from_cause(corridor, seed, str(error)) from error
        for leftover in folder.glob(".*-*"):
            # Its writer may finish just now, and another user may own it.
            with contextlib.suppress(FileNotFoundError, PermissionError):
                if time.time() - leftover.stat().st_mtime > LEFTOVER_AGE:
                    leftover.unlink()
        return folder

    def _load_or_record(self, corridor: Corridor, seed: int) -> Record:
        if corridor.recordings is not None:
            return load_record(corridor, seed)
        path, source = self.record_path(corridor, seed), _source(corridor, seed)
        try:
            return Record.load(path, source, corridor.record_shape)
        except FileNotFoundError:
            pass  # the usual first use
        except InvalidRecordError as error:
            logger.warning("record is made again: %s", error)
        self._record(corridor, [seed])
        try:
            return Record.load(path, source, corridor.record_shape)
        except (OSError, InvalidRecordError) as error:
            raise RecordingError.from_cause(corridor, seed, str(error)) from error

    def _record(
        self, corridor: Corridor, seeds: list[int], workers: int = 1, progress: bool = False
    ) -> None:
        paths = {seed: self.record_path(corridor, seed) for seed in seeds}
        self.prepare(corridor, seeds[0])
        if not progress:
            _say_recording(corridor, math.ceil(len(seeds) / workers))
        sources = {seed: _source(corridor, seed) for seed in seeds}
        about = {"desc": f"recording {corridor.name}", "unit": "seed"}
        with make_bar(len(seeds), shown=progress, **about) as bar:
            told: dict[int, str] = {}

            def remark(seed: int, text: str) -> None:
                if not text.startswith(WARNING):  # an import has shown these
                    told[seed] = text

            record_seeds(corridor, paths, sources, workers, bar.update, remark)
        if told:
            where, example = ranges(told), next(iter(told.values()))
            logger.warning("%s, traffic seeds %s: for instance %s", corridor.name, where, example)

    @contextlib.contextmanager
    def _explained_errors(self, corridor: Corridor, seeds: list[int]) -> Iterator[None]:
        """Add the library's path and how many of `seeds` it holds to an error in the body."""
        wanted = f"the {len(seeds)} requested record(s) of {corridor.name}"
        try:
            yield
        except (RecordingError, NetconvertError, SumoVersionError) as error:
            try:
                n_held = len(seeds) - len(self.missing(corridor, seeds))
            except SumoVersionError:  # its release is part of every record's path
                message = f"the library at {self.path} can neither find nor make {wanted}: {error}"
            else:
                message = (
                    f"the library at {self.path} holds {n_held} of {wanted}, and the rest cannot "
                    f"be made: {error}"
                )
            raise type(error)(message) from error


Records = str | os.PathLike[str] | RecordLibrary | None
"""A folder of records, a library, or None for the user's cache."""


def open_library(records: Records) -> RecordLibrary:
    """Return a library as it is, and that of a folder or of the user's cache otherwise.

    Raises:
        ValueError: ``records`` is none of them.
    """
    if isinstance(records, RecordLibrary):
        return records
    require(
        records is None or isinstance(records, str | os.PathLike),
        "records",
        "a path, a RecordLibrary or None",
        records,
    )
    return RecordLibrary(records)


def _say_recording(corridor: Corridor, n_seeds: int) -> None:
    """Say that traffic is recorded, one seed after another: once for a road if it takes long.

    Otherwise it is for the log alone.
    """
    seconds = (
        n_seeds * corridor.conditions.duration * sum(corridor.geometry.segment_lengths) / RECORDED
    )
    is_said = seconds < LONG or corridor.digest in _said or multiprocessing.parent_process()
    if not is_said:
        _said.add(corridor.digest)
    logger.log(
        logging.INFO if is_said else logging.WARNING,
        "Recording traffic of %s with SUMO, once for each traffic seed: %.0f s or more",
        corridor.name,
        seconds,
    )


def _used_version() -> str:
    """Return the version of libsumo, and warn if it is newer than the tested one."""
    version = sumo_version()
    if release(version) > release(TESTED_SUMO) and multiprocessing.parent_process() is None:
        warnings.warn(
            f"libsumo {version} is newer than {TESTED_SUMO}, which dptse-env is tested with: seeds "
            "give other traffic than in its results; for theirs, pip install "
            f"'libsumo~={TESTED_SUMO}.0'",
            stacklevel=1,  # one place, so that Python tells it once
        )
    return version


def _source(corridor: Corridor, seed: int) -> dict[str, object]:
    return {"corridor": corridor.digest, "seed": seed, "sumo": sumo_version()}
