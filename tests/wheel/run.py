"""Build the wheel, install it into a fresh virtual environment elsewhere, and use it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHORT = ["--env", "dptse_env:dptse/ShortHighway-v0"]
COMMANDS = [
    ["--version"],
    ["info"],
    ["record", "--corridor", "short-highway", "--seeds", "0:2", "--json"],
    [
        "train", *SHORT, "--keywords", '{"horizon": 64}', "--traffic", "0:2",
        "--validation", "1000:1002", "--output", "trained", "recipe:plackett-luce",
        "--recipe.n-envs", "4", "--recipe.replicas", "2", "--recipe.regression.rounds", "1",
        "--recipe.regression.batches", "2", "--recipe.swaps.rounds", "1",
        "--recipe.swaps.episodes", "2", "--recipe.swaps.batches", "2",
    ],
    [
        "evaluate", *SHORT, "--keywords", '{"horizon": 64}', "--seeds", "2000:2002",
        "--schedules", "round-robin", "--policies", "trained/policy.zip",
        "--estimators", "random_walk", "--output", "ladder",
    ],
]  # fmt: skip
"""A newcomer's commands, as short as they can be."""

USE = Path(__file__).with_name("use.py")


def call(*command: object, cwd: Path, **environment: str) -> None:
    """Run a command, and stop if it fails."""
    subprocess.run(
        [str(part) for part in command], cwd=cwd, env={**os.environ, **environment}, check=True
    )


def main() -> None:
    """Build, install and use the wheel in a temporary folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        call(
            sys.executable, "-m", "build", "--wheel", "--outdir", folder / "dist", ROOT, cwd=folder
        )
        (wheel,) = (folder / "dist").glob("*.whl")
        venv.create(folder / "venv", with_pip=True)
        python = folder / "venv" / "bin" / "python"
        pins = ROOT / "constraints.txt"
        call(python, "-m", "pip", "install", "--quiet", "-c", pins, wheel, cwd=folder)
        # Another project's parts: copied, so that the build leaves nothing in the checkout.
        shutil.copytree(ROOT / "tests" / "plugin", folder / "plugin")
        call(python, "-m", "pip", "install", "--quiet", "-c", pins, folder / "plugin", cwd=folder)
        (folder / "use.py").write_text(USE.read_text())
        call(python, "-W", "error", "use.py", cwd=folder, DPTSE_CACHE=str(folder / "cache"))
        # The lowest Gymnasium that is allowed must serve as well as the pinned one.
        call(python, "-m", "pip", "install", "--quiet", "gymnasium==1.2.2", cwd=folder)
        call(python, "-W", "error", "use.py", cwd=folder, DPTSE_CACHE=str(folder / "cache"))
        use_tools(python, wheel, folder)


def use_tools(python: Path, wheel: Path, folder: Path) -> None:
    """Train, evaluate and look at a policy with the installed commands, from an empty folder."""
    pins, empty = ROOT / "constraints.txt", folder / "empty"
    empty.mkdir()
    call(python, "-m", "pip", "install", "--quiet", "-c", pins, "torch", cwd=empty)
    call(python, "-m", "pip", "install", "--quiet", "-c", pins, f"{wheel}[train]", cwd=empty)
    (packages,) = (folder / "venv").glob("lib/python*/site-packages")
    assert not {"agents", "scripts"} & {path.name for path in packages.iterdir()}
    for words in COMMANDS:
        call(
            python.with_name("dptse"), *words, cwd=empty,
            DPTSE_CACHE=str(folder / "cache"), OMP_NUM_THREADS="1",
        )  # fmt: skip
    assert (empty / "trained" / "policy.zip").is_file()
    assert (empty / "ladder" / "summary.json").is_file()


if __name__ == "__main__":
    main()
