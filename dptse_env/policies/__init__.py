"""Saved policies: files are read without torch; some policies come with the package."""

import os
from importlib.resources import files
from pathlib import Path

from dptse_env.policies.reading import CARD, LARGEST_FILE, WEIGHTS, PolicyFile, parse_policy

__all__ = [
    "CARD",
    "TRANSFERABLE",
    "WEIGHTS",
    "PolicyFile",
    "parse_policy",
    "read_policy",
    "shipped_policies",
]

TRANSFERABLE = ("corridor", "bandwidth")
"""Properties that a caller may allow to differ between a policy and its environment."""


def shipped_policies() -> list[str]:
    """Return the names of the policies that come with the package."""
    entries = files("dptse_env").joinpath("policies").iterdir()
    return sorted(entry.name[:-4] for entry in entries if entry.name.endswith(".zip"))


def read_policy(source: str | os.PathLike[str]) -> PolicyFile:
    """Read a saved policy.

    Args:
        source: The name of a policy that comes with the package, or a file.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is not a saved policy, is damaged, or exceeds a limit of
            `dptse_env.policies.reading`.
    """
    name = os.fspath(source)
    if name in shipped_policies():
        path = files("dptse_env").joinpath("policies", f"{name}.zip")
        return parse_policy(path.read_bytes(), name)
    if not Path(source).is_file():
        known = ", ".join(shipped_policies()) or "none"
        raise FileNotFoundError(
            f"there is no saved policy {name!r}: neither a file, nor one of those that come with "
            f"the package ({known})"
        )
    with Path(source).open("rb") as file:
        return parse_policy(file.read(LARGEST_FILE + 1), name)
