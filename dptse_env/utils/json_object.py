"""JSON objects with known keys, the format of the package's files."""

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any


def shipped_texts(package: str, folder: str) -> dict[str, str]:
    """Return the JSON files in a folder of a package by name, without the suffix and sorted."""
    entries = sorted((files(package) / folder).iterdir(), key=lambda entry: entry.name)
    return {
        entry.name.removesuffix(".json"): entry.read_text(encoding="utf-8")
        for entry in entries
        if entry.name.endswith(".json")
    }


def parse_object(text: str | bytes, path: str, keys: Mapping[str, type]) -> dict[str, Any]:
    """Parse a JSON object that has exactly the given keys.

    Args:
        text: The JSON, as text or as the bytes of a file.
        path: Its path, for error messages.
        keys: Type of each value by its key.

    Raises:
        ValueError: It is no JSON, no object, or has other keys or types; the message starts with
            ``path``.
    """
    return check_object(parse_json(text, path), path, keys)


def parse_json(text: str | bytes, path: str) -> Any:
    """Parse JSON.

    Raises:
        ValueError: It is no JSON; the message starts with ``path``.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise ValueError(f"{path} must be JSON: {problem}") from problem


def check_object(content: Any, path: str, keys: Mapping[str, type]) -> dict[str, Any]:
    """Return parsed JSON where it is an object that has exactly the given keys.

    Raises:
        ValueError: It is no object, or has other keys or types; the message starts with ``path``.
    """
    if not isinstance(content, dict) or set(content) != set(keys):
        got = str(sorted(content) if isinstance(content, dict) else content)[:200]
        raise ValueError(f"{path} must be a mapping with the keys {', '.join(keys)}, got {got}")
    for key, kind in keys.items():
        if not isinstance(content[key], kind) or isinstance(content[key], bool):
            raise ValueError(f"{path}: {key} must be of type {kind.__name__}, got {content[key]!r}")
    return content
