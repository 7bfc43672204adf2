"""`ServedLibrary`: a library whose records come from another machine when they are needed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from dptse_env.traffic import Corridor, RecordLibrary
from dptse_env.traffic.stored_arrays import pack, unpack
from dptse_env.utils.extras import needed_for

with needed_for("a library of records on another machine"):
    from filelock import FileLock


class Server(Protocol):
    """Gives records of a library on another machine."""

    def record(self, corridor: Corridor, seed: int) -> bytes | None:
        """Return the archive of a record; None if the library does not have it."""


class LocalServer:
    """Gives the records of a library on this machine; see `Server`."""

    def __init__(self, library: RecordLibrary) -> None:
        """Take the library."""
        self._library = library

    def record(self, corridor: Corridor, seed: int) -> bytes | None:
        """See `Server.record`."""
        path = self._library.record_path(corridor, seed)
        return pack(path) if path.is_dir() else None


class ServedLibrary(RecordLibrary):
    """A library that lies in a folder of this machine, and gets what it lacks from a server.

    A record is brought once to a machine, however many of its processes want it at once, and
    appears under its name when it is complete. What the server lacks, too, is recorded here.
    """

    def __init__(
        self, path: str | os.PathLike[str] | None, server: Server, n_open: int = 64
    ) -> None:
        """Take the folder, that of the user's cache if None, and the server."""
        super().__init__(path, n_open)
        self.server = server

    def __reduce__(self) -> tuple[type[ServedLibrary], tuple[Any, ...]]:
        """Pickle as folder and server."""
        return type(self), (None if self.is_default else self.path, self.server, self.n_open)

    def bring(self, corridor: Corridor, seed: int) -> None:
        """See `RecordLibrary.bring`.

        Raises:
            OSError: It cannot be written here.
        """
        path = self.record_path(corridor, seed)
        # Imported records lie beside their road file, which every machine reads for itself.
        if corridor.recordings is not None or path.is_dir():
            return
        with _locked(path):
            if path.is_dir():
                return  # another process of this machine has brought it meanwhile
            archive = self.server.record(corridor, seed)
            if archive is not None:
                unpack(archive, path)


def _locked(path: Path) -> FileLock:
    """Return a lock on the making of a path, which other processes of this machine respect."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(path.parent / f".{path.name}.lock")
