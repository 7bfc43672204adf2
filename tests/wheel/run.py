"""Build both archives, install the wheel into a fresh virtual environment elsewhere, and use it.

The wheel is built from the source archive, so that both have what they need.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
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
        call(sys.executable, "-m", "build", "--outdir", folder / "dist", ROOT, cwd=folder)
        (wheel,) = (folder / "dist").glob("*.whl")
        (source,) = (folder / "dist").glob("*.tar.gz")
        call(sys.executable, "-m", "twine", "check", "--strict", wheel, source, cwd=folder)
        check_content(wheel)
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


def check_content(wheel: Path) -> None:
    """Check that a wheel has the package, its data, and nothing else."""
    names = zipfile.ZipFile(wheel).namelist()
    foreign = [name for name in names if not name.startswith(("dptse_env/", "dptse_env-"))]
    left_over = [name for name in names if name.endswith((".pyc", ".nbi", ".nbc", ".tmp"))]
    assert not foreign + left_over, foreign + left_over
    tools = "dptse_env/_tools"
    for needed in (
        "dptse_env/policies/private-highway.zip",
        "dptse_env/estimators/learned/shipped/highway-flows.npz",
        f"{tools}/scripts/dptse.py",
        f"{tools}/agents/suite/cards/query-suite-v1/round-robin.json",
        f"{tools}/agents/studies/paper/report.md.j2",
    ):
        assert needed in names, needed


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
