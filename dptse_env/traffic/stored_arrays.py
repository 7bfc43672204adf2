"""Arrays in a folder with a manifest: written completely or not at all, checked when read."""

import contextlib
import errno
import hashlib
import io
import json
import os
import shutil
import tarfile
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MANIFEST = "manifest.json"


class InvalidRecordError(ValueError):
    """A stored record is damaged, incomplete, or not the requested one."""


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> None:
    """Write arrays and a header to the directory `path`, completely or not at all.

    An existing directory stays as it is.

    Args:
        path: directory to create; its parents are created too.
        arrays: the arrays by name, of plain dtypes.
        header: JSON description, checked again by `load_arrays`.

    Raises:
        OSError: It cannot be written; `path` is then unchanged.
    """
    with _published(path) as temporary:
        for name, array in arrays.items():
            with _array_path(temporary, name).open("wb") as file:
                np.save(file, array, allow_pickle=False)
                os.fsync(file.fileno())
        manifest = {**header, "sha256": _checksum(temporary, list(arrays), header)}
        with (temporary / MANIFEST).open("w", encoding="utf-8") as text:
            json.dump(manifest, text, indent=2)
            text.flush()
            os.fsync(text.fileno())


def load_arrays(
    path: Path, names: Sequence[str], wanted: Mapping[str, Any]
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Open stored arrays, mapped into memory, read-only, and return them with their header.

    Args:
        path: the directory.
        names: names of the arrays, in the order in which they were saved.
        wanted: entries that the header must have.

    Raises:
        FileNotFoundError: There is no such directory.
        InvalidRecordError: It is damaged or incomplete, or an entry of the header is another.
    """
    if not path.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    try:
        header = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        checksum = header.pop("sha256")
        for key, expected in wanted.items():
            if header[key] != expected:
                raise InvalidRecordError(f"{path}: {key} is {header[key]!r}, not {expected!r}")
        if _checksum(path, names, header) != checksum:
            raise InvalidRecordError(f"{path}: the checksum does not match")
        return {name: np.load(_array_path(path, name), mmap_mode="r") for name in names}, header
    except InvalidRecordError:
        raise
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InvalidRecordError(f"{path}: {error!r}") from error


def pack(path: Path) -> bytes:
    """Return the files of the directory `path` as one compressed archive, for `unpack`.

    Raises:
        OSError: They cannot be read.
    """
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w:gz", compresslevel=1) as tar:
        for file in sorted(path.iterdir()):
            tar.add(file, file.name)
    return archive.getvalue()


def unpack(archive: bytes, path: Path) -> None:
    """Write the files of an archive to the directory `path`, completely or not at all.

    An existing directory stays as it is.

    Raises:
        OSError: They cannot be written; `path` is then unchanged.
        ValueError: The archive has something else than files.
    """
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar, _published(path) as temporary:
        for member in tar:
            content = tar.extractfile(member)
            if content is None or Path(member.name).name != member.name:
                raise ValueError(f"an archive of a record must have files alone, got {member.name}")
            with (temporary / member.name).open("wb") as file:
                shutil.copyfileobj(content, file)
                file.flush()
                os.fsync(file.fileno())


@contextlib.contextmanager
def _published(path: Path) -> Iterator[Path]:
    """Give a new directory to write to, and rename it to `path` if the body ends well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}-{uuid.uuid4().hex}"
    temporary.mkdir()
    try:
        yield temporary
        _publish(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _array_path(directory: Path, name: str) -> Path:
    return directory / f"{name}.npy"


def _checksum(directory: Path, names: Sequence[str], header: Mapping[str, Any]) -> str:
    """SHA-256 (hex) over the manifest's other entries and the files of the arrays."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in names:
        with _array_path(directory, name).open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _publish(temporary: Path, path: Path) -> None:
    """Rename the finished directory, unless another process has published the same."""
    try:
        temporary.rename(path)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
            raise
        return
    if os.name == "posix":
        parent = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(parent)
        finally:
            os.close(parent)
