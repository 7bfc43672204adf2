"""Digests of files and of plain values."""

import hashlib
import json
import os
from pathlib import Path
from types import ModuleType
from typing import Any


def file_digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 (hex) of a file's content.

    Raises:
        OSError: The file cannot be read.
    """
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def package_digest(package: ModuleType) -> str:
    """Return 12 digits of a digest of a package's code, which changes more often than its version.

    Raises:
        OSError: A source file cannot be read.
    """
    assert package.__file__ is not None
    digest, root = hashlib.sha256(), Path(package.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def json_digest(content: Any) -> str:
    """Return the SHA-256 (hex) of plain values as JSON, whatever the order of keys.

    Raises:
        TypeError: A value is not plain.
    """
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
