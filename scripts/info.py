"""Print versions, machine and caches, as a bug report needs them.

dptse info
"""

from __future__ import annotations

import os
import platform
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dptse_env
from dptse_env.traffic import RecordLibrary
from dptse_env.traffic.library import CACHE_VARIABLE
from dptse_env.utils.kernels import default_folder
from dptse_env.utils.threads import n_cores
from dptse_env.versions import code_version, installed
from scripts.cli import Command

PACKAGES = (
    "gymnasium", "libsumo", "sumolib", "eclipse-sumo", "numpy", "scipy", "numba", "mpmath",
    "filterpy", "qpsolvers", "piqp", "safetensors", "matplotlib", "platformdirs", "tomli-w",
    "tqdm", "torch", "stable-baselines3", "sb3-contrib", "optuna", "plotly", "polars", "loky",
    "rich", "tyro", "ray", "filelock", "moviepy", "pygame-ce", "tomlkit",
)  # fmt: skip

VARIABLES = (CACHE_VARIABLE, "NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "OMP_NUM_THREADS", "SUMO_HOME")
"""Environment variables that change what the package does."""


@dataclass(frozen=True, kw_only=True)
class Args(Command):
    """Print versions, machine and caches."""


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


def main(args: Args) -> None:
    """Print."""
    found = collect()
    packages = found["packages"]
    lacking = [name for name, version in packages.items() if version is None]
    there = ", ".join(f"{name}=={version}" for name, version in packages.items() if version)
    lists = there, f"not installed: {', '.join(lacking) or 'none'}"
    args.answer(
        found,
        f"dptse-env {found['dptse-env']} in {found['folder']}",
        f"Python {found['python']}, {found['platform']}, {found['cores']} cores",
        *(textwrap.fill(text, 79, break_on_hyphens=False) for text in lists),
        *(
            "{}: {files} files, {megabytes} MB in {folder}".format(cache, **found[cache])
            for cache in ("records", "kernels")
        ),
        *(f"{name}={value}" for name, value in found["variables"].items()),
    )
