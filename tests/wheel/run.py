"""Build both archives, install the wheel into fresh virtual environments elsewhere, and use it.

The wheel is built from the source archive, so that both have what they need.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path

from archives import check_source, check_wheel

from dptse_env.versions import code_version

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
SHORT = ["--env", "dptse_env:dptse/ShortHighway-v0"]
BRIEFLY = 'dptse_env:dptse/ShortHighway-v0 {"horizon": 64}'
COMMANDS = [
    ["--version"],
    ["info"],
    ["record", *SHORT, "--train-seeds", "0:2", "--json"],
    [
        "train", "--env", BRIEFLY, "--train-seeds", "0:2",
        "--validation-seeds", "1000:1002", "--output", "trained", "--algorithm",
        'plackett-luce {"n_envs": 4, "regression": {"rounds": 1, "batches": 2}, '
        '"swaps": {"rounds": 1, "episodes": 2, "batches": 2}}',
    ],
    [
        "evaluate", "--env", BRIEFLY, "--test-seeds", "2000:2002",
        "--policies", "round-robin", "trained/policy.safetensors",
        "--estimators", "random_walk", "--output", "ladder",
    ],
]  # fmt: skip
"""A newcomer's commands, as short as they can be."""


@dataclass(frozen=True)
class Installed:
    """A virtual environment in a temporary folder, and the versions that it takes."""

    folder: Path
    pins: Path
    lowest: bool

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self.folder / "venv" / "bin" / "python"

    @property
    def ignored(self) -> tuple[str, ...]:
        """Warnings that are no errors: old libraries use what newer ones deprecate."""
        return ("-W", "ignore::DeprecationWarning") if self.lowest else ()

    def install(self, *wanted: object) -> None:
        """Install packages."""
        pip = ("-m", "pip", "install", "--quiet", "--constraint", self.pins)
        call(self.python, *pip, *wanted, cwd=self.folder)

    def run(self, *command: object, cwd: Path) -> None:
        """Run a command with a record cache of its own."""
        call(*command, cwd=cwd, DPTSE_CACHE=str(self.folder / "cache"), OMP_NUM_THREADS="1")


def call(*command: object, cwd: Path, **environment: str) -> None:
    """Run a command, and stop if it fails."""
    subprocess.run(
        [str(part) for part in command], cwd=cwd, env={**os.environ, **environment}, check=True
    )


def main() -> None:
    """Build, install and use the wheel in a temporary folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default=sys.executable, help="interpreter to install it for")
    parser.add_argument("--archives", type=Path, help="folder of archives that are built already")
    parser.add_argument(
        "--lowest", action="store_true",
        help="take the lowest versions that pyproject.toml allows, and run the fast tests, too",
    )  # fmt: skip
    parser.add_argument("--torch", help="with --lowest: a version of torch instead of the lowest")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        archives = args.archives and args.archives.resolve()
        if archives is None:
            archives = folder / "dist"
            call(sys.executable, "-m", "build", "--outdir", archives, ROOT, cwd=folder)
        (wheel,) = archives.glob("*.whl")
        (source,) = archives.glob("*.tar.gz")
        call(sys.executable, "-m", "twine", "check", "--strict", wheel, source, cwd=folder)
        check_wheel(wheel, ROOT)
        check_source(source, ROOT)
        pins = lowest_versions(folder, args.python, args.torch) if args.lowest else None
        installed = Installed(folder, pins or ROOT / "constraints.txt", args.lowest)
        call(args.python, "-m", "venv", folder / "venv", cwd=folder)
        use_package(installed, wheel)
        use_tools(installed, wheel)
        if args.lowest:
            run_tests(installed, wheel, source)


def lowest_versions(folder: Path, python: str, torch: str | None) -> Path:
    """Write the lowest versions of all that is required directly, as constraints."""
    override, lowest = folder / "override.txt", folder / "lowest.txt"
    override.write_text("" if torch is None else f"torch=={torch}\n")
    call(
        sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--resolution", "lowest-direct",
        "--extra", "dev", "--override", override, "--python", python, "--no-annotate",
        "--output-file", lowest, ROOT / "pyproject.toml", cwd=folder,
    )  # fmt: skip
    return lowest


def use_package(installed: Installed, wheel: Path) -> None:
    """Use the wheel without extras, as another project would."""
    folder = installed.folder
    # Another project's parts: copied, so that the build leaves nothing in the checkout.
    shutil.copytree(ROOT / "tests" / "plugin", folder / "plugin")
    installed.install(wheel, folder / "plugin")
    use = (installed.python, "-W", "error", *installed.ignored, HERE / "use.py")
    installed.run(*use, cwd=folder)
    check = f"from dptse_env import versions; assert versions.code_version() == {code_version()!r}"
    installed.run(installed.python, "-c", check, cwd=folder)
    installed.run(installed.python, HERE / "extras.py", cwd=folder)
    if not installed.lowest:
        # The lowest Gymnasium that is allowed must serve as well as the pinned one.
        pip = ("-m", "pip", "install", "--quiet")
        call(installed.python, *pip, "gymnasium==1.2.2", cwd=folder)
        installed.run(*use, cwd=folder)


def use_tools(installed: Installed, wheel: Path) -> None:
    """Train and evaluate with the installed commands, and run a study, from an empty folder."""
    empty = installed.folder / "empty"
    empty.mkdir()
    # torch first: a looser request may bring another build.
    installed.install("torch")
    installed.install(f"{wheel}[train]")
    (packages,) = (installed.folder / "venv").glob("lib/python*/site-packages")
    assert not {"agents", "scripts"} & {path.name for path in packages.iterdir()}
    for words in COMMANDS:
        installed.run(installed.python.with_name("dptse"), *words, cwd=empty)
    assert (empty / "trained" / "policy.safetensors").is_file()
    assert (empty / "ladder" / "tables.md").is_file()
    shutil.copy(ROOT / "examples" / "my_study.py", empty)
    installed.run(installed.python, "my_study.py", cwd=empty)
    assert (empty / "results" / "my-study" / "tables.md").is_file()
    installed.run(installed.python, HERE / "extras.py", "train", cwd=installed.folder)


def run_tests(installed: Installed, wheel: Path, source: Path) -> None:
    """Run the fast tests of the source archive, with all extras that they use."""
    call(installed.python, "-m", "pip", "uninstall", "--yes", "dptse-plugin", cwd=installed.folder)
    installed.install(
        f"{wheel}[train,corridors,ray,reference,video]",
        "dp-accounting",
        "hatchling",
        "hypothesis",
        "ipykernel",
        "nbclient",
        "pytest",
        "pytest-xdist",
    )
    with tarfile.open(source) as archive:
        archive.extractall(installed.folder, filter="data")
    (unpacked,) = installed.folder.glob("dptse_env-*")
    pytest = ("-m", "pytest", "-q", "-m", "not slow and not ray", "-n", "2", *installed.ignored)
    installed.run(installed.python, *pytest, cwd=unpacked)


if __name__ == "__main__":
    main()
