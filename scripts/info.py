"""Print versions, machine and caches, as a bug report needs them.

dptse info
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dptse_env
from dptse_env.privacy import DELTAS, over_trips
from dptse_env.registration import ENVIRONMENTS
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.threads import n_cores

PACKAGES = (
    "gymnasium", "libsumo", "sumolib", "eclipse-sumo", "numpy", "scipy", "numba", "mpmath",
    "filterpy", "qpsolvers", "piqp", "safetensors", "matplotlib", "platformdirs", "tomli-w",
    "tqdm", "torch", "stable-baselines3", "sb3-contrib", "optuna", "plotly", "polars", "loky",
    "rich", "tyro", "ray", "filelock", "moviepy", "pygame", "tomlkit",
)  # fmt: skip


@dataclass(frozen=True)
class Args:
    """Print versions, machine and caches."""

    mu: float | None = None
    """Print, in place of them, what trips of one vehicle reveal together, each of this mu."""
    json: bool = False
    """Print JSON, for a program."""


def _code_digest() -> str:
    """Return 12 digits of a digest of the code, which changes more often than the version."""
    digest, root = hashlib.sha256(), Path(dptse_env.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def collect() -> dict[str, Any]:
    """Return what a bug report needs, as plain JSON."""
    library = RecordLibrary()
    records = [path for path in library.path.glob("records-*/*/*") if path.name[0] != "."]
    return {
        "dptse-env": dptse_env.__version__,
        "digest": _code_digest(),
        "folder": str(Path(dptse_env.__file__).parent),
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "cores": n_cores(),
        "packages": {name: installed(name) for name in PACKAGES},
        "records": {"folder": str(library.path), "number": len(records)},
        "environments": list(ENVIRONMENTS),
    }


def installed(package: str) -> str | None:
    """Return the version of a package; None if it is missing."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def main(args: Args) -> None:
    """Print."""
    found: dict[Any, Any] = collect() if args.mu is None else over_trips(args.mu)
    if args.json:
        print(json.dumps(found, indent=2))
        return
    if args.mu is not None:
        _print_trips(found)
        return
    packages = found.pop("packages")
    records, ids = found.pop("records"), found.pop("environments")
    for name, value in found.items():
        print(f"{name:<18} {value}")
    print(f"{'records':<18} {records['number']} in {records['folder']}")
    print(f"{'environments':<18} {', '.join(ids)}")
    for name, version in packages.items():
        print(f"{name:<18} {version or 'not installed'}")


def _print_trips(account: dict[int, dict[str, float]]) -> None:
    print(f"trips       mu  epsilon at delta = {'      '.join(DELTAS)}")
    for trips, row in account.items():
        epsilons = "".join(f"{row[delta]:10.1f}" for delta in DELTAS)
        print(f"{trips:5} {row['mu']:8.3f}{'':15}{epsilons}")
