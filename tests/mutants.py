"""Mutants: one-line changes, each of which breaks a line of the proof and must fail a fast test.

``python -m tests.mutants`` makes them one by one in a copy of the repository, runs the tests of
their module there, and prints which test has caught each; with words only the mutants whose name,
file or line of the proof has one of them. It ends with status 1 where a mutant lives, which is a
missing test, or where tests fail without one. It takes some ten minutes: run it after a change to
what ``docs/proof.md`` names.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from dptse_env.utils.kernels import default_folder

ROOT = Path(__file__).parents[1]
SPARED = (".*", "__pycache__", "build", "dist", "results")
"""What no copy needs, at any depth."""

MOST_SECONDS = 600.0
"""Time for the tests of a mutant, which may compile a kernel."""


class Mutant(NamedTuple):
    """A one-line change of the package.

    Attributes:
        name: What is wrong with it.
        line: Line of the proof in ``docs/proof.md`` that it breaks.
        path: File below ``dptse_env``.
        old: Text that stands there exactly once.
        new: What takes its place.
        tests: Files below ``tests``, a fast test of which must fail.
    """

    name: str
    line: int
    path: str
    old: str
    new: str
    tests: str

    @property
    def file(self) -> Path:
        """The file that is changed, below the root."""
        return Path("dptse_env", self.path)

    def applied(self, text: str) -> str:
        """Return the text of the file with the change.

        Raises:
            ValueError: The old text is not found, or more than once.
        """
        if text.count(self.old) != 1:
            raise ValueError(
                f"{self.path} has {text.count(self.old)} times what mutant {self.name!r} changes: "
                f"{self.old!r}"
            )
        return text.replace(self.old, self.new)


MUTANTS = (
    # --- two worlds ---------------------------------------------------------------------------
    Mutant(
        "who is connected depends on how many vehicles there are", 1,
        "traffic/penetration.py",
        "uniform = self._uniform(traffic_seed, 0, record.n_vehicles)",
        "uniform = self._uniform(traffic_seed, 0, record.n_vehicles)[::-1]",
        "traffic/test_penetration.py",
    ),
    Mutant(
        "the mask of answers shows empty segments", 2,
        "release/paced.py",
        "return Measurement(observed, values, sigma, centre)",
        "return Measurement(observed & (sums[..., 0] > 0.0), values, sigma, centre)",
        "test_non_interference.py",
    ),
)  # fmt: skip


def lines_of_the_proof() -> dict[int, str]:
    """Return the titles of the lines of the proof by their numbers."""
    page = (ROOT / "docs" / "proof.md").read_text(encoding="utf-8")
    return {int(n): title for n, title in re.findall(r"^### (\d+)\. (.+)$", page, re.MULTILINE)}


def chosen(words: list[str]) -> list[Mutant]:
    """Return the mutants whose name, file or line of the proof has one of some words."""
    return [
        mutant
        for mutant in MUTANTS
        if not words or {str(mutant.line)} & {*words}
        or any(word in f"{mutant.name} {mutant.path}" for word in words if not word.isdigit())
    ]  # fmt: skip


def failed(copy: Path, tests: list[str], **environment: str) -> str:
    """Run the fast tests of files of a copy; return the first that fails, empty if all pass.

    Raises:
        RuntimeError: They could not be run: a mutant that cannot be imported is none.
    """
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", "-m", "not slow", "-x", "-q", "-p", "no:cacheprovider",
         *(f"tests/{test}" for test in tests)],
        cwd=copy, capture_output=True, text=True, timeout=MOST_SECONDS, check=False,
        # Without CI hypothesis would try other examples each time.
        env={**os.environ, "PYTHONPATH": str(copy), "CI": "true", **environment},
    )  # fmt: skip
    if ended.returncode == 0:
        return ""
    found = re.search(r"^(?:FAILED|ERROR) tests/(\S+)", ended.stdout, re.MULTILINE)
    if ended.returncode != 1 or found is None:
        raise RuntimeError(f"pytest ended with {ended.returncode}:\n{ended.stdout}{ended.stderr}")
    return found[1]


def main(words: list[str]) -> int:
    """Make some mutants, print how each fared, and return the exit status."""
    mutants = chosen(words)
    if not mutants:
        print(f"no mutant has any of {words} in its name, file or line of the proof")
        return 1
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy, kernels = Path(folder, "repository"), Path(folder, "kernels")
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*SPARED))
        # Kernels are found by their code: those of the user serve, and a mutant's are not kept.
        if default_folder().is_dir():
            shutil.copytree(default_folder(), kernels)
        environment = {"NUMBA_CACHE_DIR": str(kernels)}
        if found := failed(copy, sorted({t for m in mutants for t in m.tests.split()}), **environment):
            print(f"without a mutant, {found} fails")
            return 1
        # Bytecode of a mutant could be taken for that of the file, which has the same size.
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        n_lived = 0
        print("| mutant | line of the proof | killed by | seconds |\n| :-- | :-- | :-- | --: |")
        for mutant in mutants:
            file, start = copy / mutant.file, time.monotonic()
            before = file.read_text(encoding="utf-8")
            file.write_text(mutant.applied(before), encoding="utf-8")
            killer = failed(copy, mutant.tests.split(), **environment)
            shutil.copy2(ROOT / mutant.file, file)
            n_lived += not killer
            seconds = time.monotonic() - start
            print(
                f"| {mutant.name} | {mutant.line} | {killer or '**lives**'} | {seconds:.0f} |",
                flush=True,
            )
    print(f"\n{len(mutants) - n_lived} of {len(mutants)} mutants die")
    return int(n_lived > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
