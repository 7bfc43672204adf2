"""Print versions, machine and caches, as a bug report needs them.

dptse info
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dptse_env
from dptse_env.privacy import DELTAS, over_trips, rounded_up
from dptse_env.traffic import RecordLibrary
from dptse_env.traffic.library import CACHE_VARIABLE
from dptse_env.utils.kernels import default_folder
from dptse_env.utils.threads import n_cores
from dptse_env.versions import code_version

PACKAGES = (
    "gymnasium", "libsumo", "sumolib", "eclipse-sumo", "numpy", "scipy", "numba", "mpmath",
    "filterpy", "qpsolvers", "piqp", "safetensors", "matplotlib", "platformdirs", "tomli-w",
    "tqdm", "torch", "stable-baselines3", "sb3-contrib", "optuna", "plotly", "polars", "loky",
    "rich", "tyro", "ray", "filelock", "moviepy", "pygame", "tomlkit",
)  # fmt: skip

VARIABLES = (CACHE_VARIABLE, "NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "OMP_NUM_THREADS", "SUMO_HOME")
"""Environment variables that change what the package does."""


@dataclass(frozen=True)
class Args:
    """Print versions, machine and caches."""

    mu: float | None = None
    """Print, in place of them, what trips of one vehicle reveal together, each of this mu."""
    json: bool = False
    """Print JSON, for a program."""


def collect() -> dict[str, Any]:
    """Return what a bug report needs, as plain JSON."""
    records, kernels = RecordLibrary().path, default_folder()
    return {
        "dptse-env": code_version(),
        "folder": str(Path(dptse_env.__file__).parent),
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "cores": n_cores(),
        "packages": {name: installed(name) for name in PACKAGES},
        "records": _content(records, "records-*/*/[!.]*"),
        "kernels": _content(kernels, "*.machine-code"),
        "variables": {name: os.environ[name] for name in VARIABLES if name in os.environ},
    }


def _content(folder: Path, pattern: str) -> dict[str, Any]:
    """Return folder, number and size of the files that a pattern fits."""
    sizes = [path.stat().st_size for path in folder.glob(pattern)]
    return {"folder": str(folder), "files": len(sizes), "megabytes": round(sum(sizes) / 1e6, 1)}


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
    packages = found["packages"]
    lacking = [name for name, version in packages.items() if version is None]
    print(f"dptse-env {found['dptse-env']} in {found['folder']}")
    print(f"Python {found['python']}, {found['platform']}, {found['cores']} cores")
    for text in (
        ", ".join(f"{name}=={version}" for name, version in packages.items() if version),
        f"not installed: {', '.join(lacking) or 'none'}",
    ):
        print(textwrap.fill(text, 79, break_on_hyphens=False))
    for cache in ("records", "kernels"):
        has = found[cache]
        print(f"{cache}: {has['files']} files, {has['megabytes']} MB in {has['folder']}")
    for name, value in found["variables"].items():
        print(f"{name}={value}")


def _print_trips(account: dict[int, dict[str, float]]) -> None:
    print(f"trips       mu  epsilon at delta = {'      '.join(DELTAS)}")  # all rounded up
    for trips, row in account.items():
        epsilons = "".join(rounded_up(row[delta], "10.1f") for delta in DELTAS)
        print(f"{trips:5} {rounded_up(row['mu'], '8.3f')}{'':15}{epsilons}")
