"""The library of records on disk: each scenario is recorded once and then only read.

A record is found by the corridor's digest, the traffic seed, SUMO's version and the record format;
when any of them changes, another record is made. Several processes may use a library at once.
"""

import logging
import os
import shutil
import threading
import uuid
from collections import OrderedDict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import platformdirs
from tqdm import tqdm

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.record import VERSION, InvalidRecordError, Record
from dptse_env.traffic.sumo import RecordingError, simulate, simulation_is_loaded, sumo_version
from dptse_env.traffic.worker import WorkerPool
from dptse_env.validation import integer

CACHE_VARIABLE = "DPTSE_CACHE"
"""Environment variable that overrides where records are kept."""

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
        n_open: how many records stay open, at four file descriptors each; opening one again takes
            a few milliseconds.

    Raises:
        ValueError: if `n_open` is not positive.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, n_open: int = 64) -> None:
        """Remember the path; nothing is read or written yet."""
        self.path = default_path() if path is None else Path(path).expanduser()
        self.n_open = integer("library.n_open", n_open, 1)
        self._open: OrderedDict[tuple[str, int], Record] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type["RecordLibrary"], tuple[Path, int]]:
        """Pickle as the path alone: another process opens its own records."""
        return type(self), (self.path, self.n_open)

    def get(self, corridor: Corridor, seed: int) -> Record:
        """Return a record, made now if it is missing or damaged.

        Args:
            corridor: the corridor.
            seed: traffic seed, a non-negative integer.

        Raises:
            ValueError: if the seed is negative or no integer.
            RecordingError: if the record cannot be made; the message names the seed.
            NetworkError: if the corridor has to be compiled and cannot be.
            SumoVersionError: if libsumo is missing or of another release series.
        """
        seed = integer("traffic seed", seed, 0)
        key = corridor.digest, seed
        with self._lock:
            record = self._open.get(key)
            if record is None:
                record = self._open[key] = self._load_or_record(corridor, seed)
                if len(self._open) > self.n_open:
                    self._open.popitem(last=False)
            else:
                self._open.move_to_end(key)
            return record

    def ensure(
        self,
        corridor: Corridor,
        seeds: Iterable[int],
        workers: int | None = None,
        progress: bool = False,
    ) -> None:
        """Record whichever of `seeds` are missing, several at once.

        Args:
            corridor: the corridor.
            seeds: traffic seeds.
            workers: number of processes; default: the number of usable cores.
            progress: whether to show a progress bar on stderr.

        Raises:
            ValueError: if a seed or the number of workers is out of range.
            RecordingError: if one of them fails; the message names the seed. The others that were
                already running are finished and kept, the rest is not begun.
        """
        n_workers = _n_cores() if workers is None else integer("workers", workers, 1)
        wanted = dict.fromkeys(integer("traffic seed", seed, 0) for seed in seeds)
        missing = [seed for seed in wanted if not self.record_path(corridor, seed).is_dir()]
        if not missing:
            return
        with (
            tqdm(
                total=len(missing), desc=corridor.name, unit="record", disable=not progress
            ) as bar,
            WorkerPool() as pool,
            ThreadPoolExecutor(min(n_workers, len(missing))) as threads,
        ):
            futures = [
                threads.submit(
                    pool.record,
                    corridor,
                    seed,
                    self.record_path(corridor, seed),
                    _source(corridor, seed),
                )
                for seed in missing
            ]
            try:
                for future in as_completed(futures):
                    future.result()
                    bar.update()
            except BaseException:
                threads.shutdown(cancel_futures=True)
                raise

    def record_path(self, corridor: Corridor, seed: int) -> Path:
        """Return the directory that holds a record, or will."""
        folder = f"records-v{VERSION}-sumo-{sumo_version()}"
        return self.path / folder / corridor.digest[:32] / f"{seed:08d}"

    def _load_or_record(self, corridor: Corridor, seed: int) -> Record:
        path, source = self.record_path(corridor, seed), _source(corridor, seed)
        try:
            return Record.load(path, source)
        except FileNotFoundError:
            pass  # the usual first use
        except InvalidRecordError as error:
            logger.warning("record is made again: %s", error)
            _discard(path)
        try:
            if simulation_is_loaded():
                with WorkerPool() as pool:
                    pool.record(corridor, seed, path, source)
            else:
                simulate(corridor, seed).save(path, source)
            return Record.load(path, source)
        except (OSError, InvalidRecordError) as error:
            raise RecordingError.of(corridor, seed, str(error)) from error


def _source(corridor: Corridor, seed: int) -> dict[str, object]:
    return {"corridor": corridor.digest, "seed": seed, "sumo": sumo_version()}


def _discard(path: Path) -> None:
    """Remove a record by moving it aside first, so that nobody finds half of it."""
    aside = path.parent / f".{path.name}-{uuid.uuid4().hex}"
    try:
        path.rename(aside)
    except FileNotFoundError:
        return  # another process has discarded it already
    shutil.rmtree(aside, ignore_errors=True)


def _n_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
