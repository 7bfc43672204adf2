"""Contents of a release's archives: the tracked files of some folders, and nothing else."""

from __future__ import annotations

import re
import subprocess
import tarfile
import zipfile
from collections.abc import Iterable
from email import message_from_bytes
from pathlib import Path

import readme_renderer.markdown

PACKAGES = {
    "dptse_env": "dptse_env",
    "agents": "dptse_env/_tools/agents",
    "scripts": "dptse_env/_tools/scripts",
    "results/suite/rows.parquet": "dptse_env/_tools/results/suite/rows.parquet",
}
"""Folders and files of the repository that are in a wheel, and where."""

FOLDERS = {*PACKAGES, "benchmarks", "docs", "examples", "paper", "tests"}
"""Folders of a source archive."""
BESIDE_THEM = {
    ".gitignore", "CHANGELOG.md", "CITATION.cff", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md",
    "LICENSE", "Makefile", "README.md", "SECURITY.md", "constraints.txt", "hatch_build.py",
    "pyproject.toml", "zensical.toml",
}  # fmt: skip

LARGEST = 4_000_000
"""Most bytes of an archive."""


def check_wheel(wheel: Path, root: Path) -> None:
    """Check that a wheel has the packages with their data, and nothing else."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        check_page(archive.read(metadata))
    about = metadata.removesuffix("METADATA")
    expected = {
        PACKAGES[folder] + name.removeprefix(folder)
        for folder in PACKAGES
        for name in tracked(root, [folder])
    } | {about + name for name in ("METADATA", "RECORD", "WHEEL", "entry_points.txt")}
    _check(wheel, names, expected | {about + "licenses/LICENSE"})


def check_source(source: Path, root: Path) -> None:
    """Check that a source archive has what builds, tests and documents, and nothing else."""
    with tarfile.open(source) as archive:
        names = [each.name.partition("/")[2] for each in archive if each.isfile()]
    _check(source, names, {*tracked(root, FOLDERS), *BESIDE_THEM, "PKG-INFO"})


def check_page(metadata: bytes) -> None:
    """Check that the description can be rendered, and leads to nothing beside it."""
    text = message_from_bytes(metadata).get_payload(decode=True).decode()
    page = readme_renderer.markdown.render(text)
    assert page is not None, "the README cannot be rendered"
    beside = re.findall(r'(?:href|src)="(?!https://|#|mailto:)([^"]*)"', page)
    assert not beside, f"on a package page these lead nowhere: {beside}"


def tracked(root: Path, folders: Iterable[str]) -> list[str]:
    """Return the files of folders that git tracks, from the root on."""
    listed = subprocess.run(
        ["git", "-C", root, "ls-files", "-z", "--", *folders],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return listed.stdout.rstrip("\0").split("\0")


def _check(archive: Path, names: list[str], expected: set[str]) -> None:
    more, fewer = set(names) - expected, expected - set(names)
    assert not more, f"{archive.name} must not hold {sorted(more)}"
    assert not fewer, f"{archive.name} must hold {sorted(fewer)}"
    size = archive.stat().st_size
    assert size <= LARGEST, f"{archive.name} has {size} bytes"
    print(f"{archive.name}: {len(names)} files, {size / 1e6:.2f} MB")
