"""Digests of files and of plain values."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any


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
