"""Saved policies as files, as far as one gets without torch; those that come with the package."""

from __future__ import annotations

import os
from importlib.resources import files
from pathlib import Path

CARD = "card.json"
"""The card in a saved policy: plain JSON that says what it is and what it fits."""

TRANSFERABLE = ("corridor", "bandwidth")
"""What a caller may allow to differ between a policy and the environment that it acts in."""


def shipped_policies() -> list[str]:
    """Return the names of the policies that come with the package."""
    entries = files("dptse_env").joinpath("policies").iterdir()
    return sorted(entry.name[:-4] for entry in entries if entry.name.endswith(".zip"))


def read_policy(source: str | os.PathLike[str]) -> bytes:
    """Return the content of a saved policy.

    Args:
        source: A file, or the name of a policy that comes with the package; such a name comes
            first.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
    """
    name = os.fspath(source)
    if name in shipped_policies():
        return files("dptse_env").joinpath("policies", f"{name}.zip").read_bytes()
    path = Path(source)
    if not path.is_file():
        known = ", ".join(shipped_policies()) or "none"
        raise FileNotFoundError(
            f"there is no saved policy {name!r}: neither a file, nor of those that come with the "
            f"package ({known})"
        )
    return path.read_bytes()
