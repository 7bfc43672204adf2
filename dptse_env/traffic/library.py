"""The library of records on disk: each scenario is recorded once and then only read.

A record is found by the corridor's digest, the traffic seed, SUMO's version and the record format;
when any of them changes, another record is made. Several processes may use a library at once.

The records of a corridor with recordings come from their folder instead, and are never made.

A record appears under its name when it is complete, so a writer that is killed leaves a hidden
file at most. Its writer may still run, perhaps on another machine, so such a file is removed when
it has reached a certain age.
"""

import contextlib
import logging
import os
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import platformdirs
from tqdm import tqdm

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.imported import load_record, record_path, require_seeds
from dptse_env.traffic.record import RECORD_VERSION, InvalidRecordError, Record
from dptse_env.traffic.sumo import (
    RecordingError,
    SumoVersionError,
    simulate,
    simulation_is_loaded,
    sumo_version,
)
from dptse_env.traffic.sumo_network import NetworkError
from dptse_env.traffic.worker import WorkerPool
from dptse_env.utils.fields import integer, require
from dptse_env.utils.threads import n_cores

CACHE_VARIABLE = "DPTSE_CACHE"
"""Environment variable with the directory of the records."""

LEFTOVER_AGE = 6 * 3600.0
"""Age [s] at which a hidden file is considered abandoned. Writing takes a second."""

logger = logging.getLogger(__name__)


def default_path() -> Path:
    """Return the directory named by ``DPTSE_CACHE``, or else the user's cache directory."""
    configured = os.environ.get(CACHE_VARIABLE)
    return Path(configured) if configured else platformdirs.user_cache_path("dptse-env")


class RecordLibrary:
    """Records by corridor and traffic seed, made on first use.

    Args:
        path: the library's directory; created when the first record is written. Default:
            `default_path`.
        n_open: largest number of records kept in memory; reading one again takes a millisecond.

    Raises:
        ValueError: `n_open` is not positive.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, n_open: int = 64) -> None:
        """Store the path; nothing is read or written yet."""
        self.is_default = path is None
        self.path = default_path() if path is None else Path(path).expanduser()
        self.n_open = integer("library.n_open", n_open, 1)
        self._open: OrderedDict[tuple[str, int], Record] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type["RecordLibrary"], tuple[Any, ...]]:
        """Pickle as the path alone: each process opens the records itself.

        The default path is found anew, as another machine may have another one.
        """
        return type(self), (None if self.is_default else self.path, self.n_open)

    def get(self, corridor: Corridor, seed: int) -> Record:
        """Return the record of a traffic seed, which is made now if it is missing or damaged.

        Raises:
            ValueError: The seed is negative or no integer, or was not recorded.
            InvalidRecordError: A record of the corridor's recordings is damaged or exchanged.
            RecordingError: The record cannot be made; the message names the library and the seed.
            NetworkError: The corridor has to be compiled and cannot be.
            SumoVersionError: libsumo is missing, broken or of another release series.
        """
        seed = integer("traffic seed", seed, 0)
        key = corridor.digest, seed
        with self._lock:
            record = self._open.get(key)
            if record is None:
                with self._explained_errors(corridor, [seed]):
                    record = self._open[key] = self._load_or_record(corridor, seed)
                if len(self._open) > self.n_open:
                    self._open.popitem(last=False)
            else:
                self._open.move_to_end(key)
            return record

    def missing(self, corridor: Corridor, seeds: Iterable[int]) -> list[int]:
        """Return those of `seeds` that have no record yet, each once and in the order given.

        Nothing is opened: a damaged record counts as present, and `get` makes it again.

        Raises:
            ValueError: A seed is negative or no integer, or was not recorded.
            SumoVersionError: libsumo is missing or of another release series.
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
        """Make the missing records of `seeds`, several at once.

        A single record, or all of them with one worker, are made in this process unless libsumo
        holds another simulation here. A worker that dies is replaced and its record tried again
        (see `WorkerPool.record`).

        The default number of `workers` is that of usable cores; `progress` shows a progress bar.

        Raises:
            ValueError: A seed or the number of workers is out of range, or a seed was not recorded.
            RecordingError: A recording fails; the message names its seed and the number of records
                in the library. Recordings in progress are finished and kept, no other is started.
            NetworkError: The corridor has to be compiled and cannot be.
            SumoVersionError: libsumo is missing, broken or of another release series.
        """
        n_workers = n_cores() if workers is None else integer("workers", workers, 1)
        wanted = list(dict.fromkeys(integer("traffic seed", seed, 0) for seed in seeds))
        with self._explained_errors(corridor, wanted):
            missing = self.missing(corridor, wanted)
            if missing:
                self._record(corridor, missing, min(n_workers, len(missing)), progress)

    def record_path(self, corridor: Corridor, seed: int) -> Path:
        """Return the file of a record, whether it exists or not."""
        if corridor.recordings is not None:
            return record_path(corridor.recordings.folder, seed)
        folder = f"records-v{RECORD_VERSION}-sumo-{sumo_version()}"
        return self.path / folder / corridor.digest[:32] / f"{seed:08d}.safetensors"

    def _load_or_record(self, corridor: Corridor, seed: int) -> Record:
        if corridor.recordings is not None:
            return load_record(corridor.recordings, seed, corridor.record_layout)
        path, source = self.record_path(corridor, seed), _source(corridor, seed)
        try:
            return Record.load(path, source)
        except FileNotFoundError:
            pass  # the usual first use
        except InvalidRecordError as error:
            logger.warning("record is made again: %s", error)
            path.unlink(missing_ok=True)
        self._record(corridor, [seed])
        try:
            return Record.load(path, source)
        except (OSError, InvalidRecordError) as error:
            raise RecordingError.from_cause(corridor, seed, str(error)) from error

    def _record(
        self, corridor: Corridor, seeds: list[int], n_workers: int = 1, progress: bool = False
    ) -> None:
        """Make the records of one or more `seeds`, in this process or in `n_workers` others."""
        folder = self.record_path(corridor, seeds[0]).parent
        try:
            _prepare(folder)
        except OSError as error:
            raise RecordingError.from_cause(corridor, seeds[0], str(error)) from error
        in_children = n_workers > 1 or simulation_is_loaded()
        logger.info(
            "%s: recording %d traffic seed(s) in %s into %s",
            corridor.name,
            len(seeds),
            f"{n_workers} child process(es)" if in_children else "this process",
            self.path,
        )
        with tqdm(total=len(seeds), desc=corridor.name, unit="record", disable=not progress) as bar:
            if in_children:
                self._record_in_children(corridor, seeds, n_workers, bar)
                return
            for seed in seeds:
                try:
                    simulate(corridor, seed).save(
                        self.record_path(corridor, seed), _source(corridor, seed)
                    )
                except OSError as error:
                    raise RecordingError.from_cause(corridor, seed, str(error)) from error
                bar.update()

    def _record_in_children(
        self, corridor: Corridor, seeds: list[int], n_workers: int, bar: tqdm
    ) -> None:
        with WorkerPool() as pool, ThreadPoolExecutor(n_workers) as threads:
            futures = [
                threads.submit(
                    pool.record,
                    corridor,
                    seed,
                    self.record_path(corridor, seed),
                    _source(corridor, seed),
                )
                for seed in seeds
            ]
            try:
                for future in as_completed(futures):
                    future.result()
                    bar.update()
            except BaseException:
                threads.shutdown(cancel_futures=True)
                raise

    @contextlib.contextmanager
    def _explained_errors(self, corridor: Corridor, seeds: list[int]) -> Iterator[None]:
        """Add the library's path and how many of `seeds` it holds to an error in the body."""
        wanted = f"the {len(seeds)} requested record(s) of {corridor.name}"
        try:
            yield
        except (RecordingError, NetworkError, SumoVersionError) as error:
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


def _source(corridor: Corridor, seed: int) -> dict[str, object]:
    return {"corridor": corridor.digest, "seed": seed, "sumo": sumo_version()}


def _prepare(folder: Path) -> None:
    """Create the folder, check that it is writable, and remove abandoned records in it.

    Raises:
        OSError: It cannot be created or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".probe-", dir=folder):
        pass
    for leftover in folder.glob(".*-*"):
        # Its writer may finish just now, and another user may own it.
        with contextlib.suppress(FileNotFoundError, PermissionError):
            if time.time() - leftover.stat().st_mtime > LEFTOVER_AGE:
                leftover.unlink()
