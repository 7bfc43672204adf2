"""Files that are complete or not there, their places and digests, and arrays with a card.

Weights and records are files in the format of safetensors: a header in JSON, then the arrays as
they are in memory. Their card, what one should know of the arrays, stands in the header's
``__metadata__`` as JSON under ``card``; it has the digest of card and arrays, too.
"""

import contextlib
import glob
import gzip
import hashlib
import json
import os
import stat
import tempfile
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import DTypeLike
from safetensors import SafetensorError
from safetensors.numpy import load, save

from dptse_env.utils.arrays import AnyArray

LARGEST_FILE = 2**24
"""Largest size of a file, where the caller says nothing else [bytes]."""

LARGEST_HEADER = 2**20
"""Largest size of a header, which the card is a part of [bytes]."""

DEEPEST_CARD = 16
"""Largest nesting of a card."""

PATIENCE = 5.0 if os.name == "nt" else 0.0
"""Longest wait for readers of a file that is to be replaced [s]; Windows refuses it meanwhile."""

_DIGEST = "sha256"


def require_writable(what: str, folder: Path) -> None:
    """Refuse a folder that neither is there nor can be made, or that nothing can be written to.

    Args:
        what: Name of the folder in the message.
        folder: The folder, which may be missing, with its parents. It is left as it is.

    Raises:
        ValueError: See above.
    """
    try:
        place = _lowest_there(folder)
        # Modes of files do not tell it: of root, of a read-only disk, of Windows.
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as problem:
        allowed = "a folder that can be written, or be made"
        raise ValueError(f"{what} must be {allowed}, got {folder}: {problem.strerror}") from problem


def _lowest_there(path: Path) -> Path:
    """Return a path, or the lowest of its parents that exists."""
    try:
        path.lstat()
    except FileNotFoundError:
        place = _lowest_there(path.parent)
        with contextlib.suppress(FileNotFoundError):
            (place / path.name).lstat()  # an error where the name is too long
        return place
    return path


def require_output(
    folder: Path,
    names: Sequence[str] | None = None,
    *,
    own: Iterable[str] = (),
    force: bool | None = None,
) -> None:
    """Refuse a folder where results cannot go. Ask before any work: a refusal loses nothing then.

    Args:
        folder: The folder, which may be missing, with its parents.
        names: What is going to be written there. If None, the folder has to be empty but for hidden
            files.
        own: Files or folders by one of which an earlier run is known, which is gone on with and
            replaces nothing.
        force: Whether files may be replaced; None where nobody can allow it.

    Raises:
        ValueError: Something else is there, nothing can be written there, or a name is too long.
    """
    require_writable("output", folder)
    for path in map(folder.joinpath, names or ()):
        try:
            _lowest_there(hidden(path))
        except OSError as problem:
            found = f"{path}: {problem.strerror}"
            raise ValueError(f"output must have another name, got {found}") from problem
    if any((folder / name).exists() for name in own):
        return
    if names is None:
        present = sorted(folder.iterdir()) if folder.is_dir() else []
        there = [path for path in present if not path.name.startswith(".")][:1]
    else:
        there = [path for path in map(folder.joinpath, names) if os.path.lexists(path)]
    if force:  # which is no leave to remove a folder
        there = [path for path in there if path.is_dir()]
    if there:
        instead = "choose another one" + (", or give --force" if force is False else "")
        found = ", ".join(map(str, there))
        raise ValueError(f"output must not exist yet, got {found}: {instead}")


def read_tensors(
    path: str | os.PathLike[str], largest: int = LARGEST_FILE
) -> tuple[dict[str, Any], dict[str, AnyArray]]:
    """Read a file of arrays that `write_tensors` wrote. Nothing in it is run.

    Args:
        path: The file.
        largest: Largest size of the file [bytes].

    Returns:
        The card, with the digest of the content as ``sha256``, and the arrays by name, read-only,
        of integers or finite floats. The caller checks what the card must have, and shapes and
        types of the arrays (`require_arrays`).

    Raises:
        FileNotFoundError: There is no such file.
        OSError: It cannot be read.
        ValueError: It is not such a file, is damaged, or exceeds a limit of this module.
    """
    try:
        status = Path(path).stat()
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is not a regular file")
        if status.st_size > largest:
            raise ValueError(f"it must have at most {largest} bytes, got {status.st_size}")
        content = Path(path).read_bytes()
    except ValueError as problem:
        raise _damaged(os.fspath(path), problem) from problem
    return parse_tensors(content, os.fspath(path))


def parse_tensors(content: bytes, name: str) -> tuple[dict[str, Any], dict[str, AnyArray]]:
    """Return what `read_tensors` returns of the content of such a file, `name` in messages.

    Raises:
        ValueError: It is no such content, is damaged, or exceeds a limit of this module.
    """
    try:
        return _parsed(content)
    except (ValueError, SafetensorError, LookupError, RecursionError) as problem:
        raise _damaged(name, problem) from problem


def _damaged(name: str, problem: Exception) -> ValueError:
    reason = " ".join(str(problem).split())
    return ValueError(f"{name} is damaged, or no safetensors file with a card: {reason:.300}")


def write_tensors(
    path: str | os.PathLike[str],
    arrays: Mapping[str, AnyArray],
    card: Mapping[str, Any],
    largest: int = LARGEST_FILE,
) -> None:
    """Write arrays and a card, completely or not at all; the same ones give the same bytes.

    Args:
        path: The file; one that is there is replaced.
        arrays: Integers and finite floats by name.
        card: Plain JSON. The digest of the content is added as ``sha256``.
        largest: Largest size of the file [bytes].

    Raises:
        OSError: It cannot be written; what was there stays.
        ValueError: `read_tensors` would refuse the file; what was there stays.
    """
    write_atomically(path, dump_tensors(arrays, card, os.fspath(path), largest))


def dump_tensors(
    arrays: Mapping[str, AnyArray],
    card: Mapping[str, Any],
    name: str,
    largest: int = LARGEST_FILE,
) -> bytes:
    """Return what `write_tensors` writes, `name` in messages.

    Raises:
        ValueError: `parse_tensors` would refuse it, or it is too large.
    """
    stored = {
        key: np.asarray(array, array.dtype.newbyteorder("<"), order="C")
        for key, array in arrays.items()
    }
    try:
        signed = {**card, _DIGEST: content_digest(card, stored)}
        content: bytes = save(stored, {"card": _text(signed)})
        if len(content) > largest:
            raise ValueError(f"it would have {len(content)} bytes, more than {largest}")
        _parsed(content)
    except (TypeError, ValueError, SafetensorError, RecursionError) as problem:
        raise ValueError(f"{name} cannot be written: {problem!s:.300}") from problem
    return content


def require_arrays(
    arrays: Mapping[str, AnyArray], shapes: Mapping[str, tuple[int, ...]], dtype: DTypeLike
) -> None:
    """Refuse other arrays than those of the given names, shapes and type.

    Raises:
        ValueError: One is missing, unknown, or of another shape or type.
    """
    for problem, names in (
        ("lacks", set(shapes) - set(arrays)),
        ("has", set(arrays) - set(shapes)),
    ):
        if names:
            raise ValueError(f"it {problem} the arrays {', '.join(sorted(names))!s:.200}")
    for name, shape in shapes.items():
        array = arrays[name]
        if array.dtype != dtype or array.shape != shape:
            raise ValueError(
                f"{name} must be {np.dtype(dtype)} of shape {shape}, got {array.dtype} of "
                f"{array.shape}"
            )


def content_digest(card: Mapping[str, Any], arrays: Mapping[str, AnyArray]) -> str:
    """Return the SHA-256 (hex) of a card and of arrays, whatever their order.

    Raises:
        ValueError: A number in the card is not finite.
        TypeError: The card is not plain JSON.
    """
    digest = hashlib.sha256(_text({k: v for k, v in card.items() if k != _DIGEST}).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _parsed(content: bytes) -> tuple[dict[str, Any], dict[str, AnyArray]]:
    """Return the card and the arrays in the content of a file.

    Raises:
        ValueError, LookupError, RecursionError, SafetensorError: It is damaged.
    """
    size = int.from_bytes(content[:8], "little")
    if size > LARGEST_HEADER:
        raise ValueError(f"its header must have at most {LARGEST_HEADER} bytes, got {size}")
    arrays: dict[str, AnyArray] = load(content)
    for name, array in arrays.items():
        array.flags.writeable = False
        if array.dtype.kind not in "iuf":
            raise ValueError(f"{name} must be of integers or floats, got {array.dtype}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite, it has NaN or infinite values")
    match _json(content[8 : 8 + size]):
        case {"__metadata__": {"card": str(text)}}:
            card = _json(text)
        case _:
            raise ValueError("it has no card")
    if not isinstance(card, dict) or _depth(card) > DEEPEST_CARD:
        raise ValueError(f"its card must be a mapping of at most {DEEPEST_CARD} levels")
    digest = card.pop(_DIGEST, None)
    if digest != content_digest(card, arrays):
        raise ValueError("its content has another digest than its card says")
    return {**card, _DIGEST: digest}, arrays


def _json(text: str | bytes) -> Any:
    return json.loads(text, object_pairs_hook=_unique)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) != len(pairs):
        raise ValueError("its header has a key twice")
    return dict(pairs)


def _text(card: Mapping[str, Any]) -> str:
    """Return a card as text. Keys keep their order, which can mean something."""
    return json.dumps(card, allow_nan=False)


def _depth(node: Any) -> int:
    if isinstance(node, dict):
        node = node.values()
    elif not isinstance(node, list):
        return 1
    return 1 + max(map(_depth, node), default=0)


def hidden(path: Path) -> Path:
    """Return where something is made that takes the place of `path` when it is complete."""
    return path.with_name(f".{path.name}-{uuid.uuid4().hex}")


def left_hidden(path: Path) -> Iterator[Path]:
    """Yield what processes that were killed have left, or others still use, of `hidden`."""
    return path.parent.glob(f".{glob.escape(path.name)}-{'[0-9a-f]' * 32}")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path, whose file takes the place of `path` when the body is done.

    Raises:
        OSError: The file cannot be written, and the error names it; the old one stays.
    """
    target = Path(os.path.realpath(path))  # a link stays one
    temporary = hidden(target)
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        _take_place(temporary, target)
    except OSError as problem:
        problem.filename = os.fspath(path)  # a full disk names none, others the temporary one
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _take_place(temporary: Path, target: Path) -> None:
    """Give a file its name, when nobody reads the old file where that matters."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            temporary.replace(target)
        except PermissionError:
            if time.monotonic() >= deadline:
                raise
            time.sleep(0.01)
        else:
            return


def write_atomically(path: str | os.PathLike[str], content: bytes | str) -> None:
    """Write a file in one piece, text as UTF-8.

    Raises:
        OSError: It cannot be written; the old one stays.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def file_digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 (hex) of a file's content.

    Raises:
        OSError: The file cannot be read.
    """
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_digest(content: Any) -> str:
    """Return the SHA-256 (hex) of plain values as JSON, whatever the order of keys.

    Raises:
        TypeError: A value is not plain.
    """
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def open_unzipped(path: Path) -> IO[bytes]:
    """Open a file, plain or gzipped, for reading its plain bytes."""
    with path.open("rb") as file:
        zipped = file.read(2) == b"\x1f\x8b"
    return cast(IO[bytes], gzip.open(path)) if zipped else path.open("rb")
