"""Versions of this code and of SUMO, with a digest of what moves numbers, for rows and cards."""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any

from dptse_env.tools import TOOLS

__version__ = "0.3.0.dev0"

TESTED_SUMO = "1.28"
"""Release of SUMO that this version is tested with, the oldest that is taken. A newer one
simulates the same scenario differently."""

PACKAGE = Path(__file__).parent

KINDS = (".json", ".py", ".safetensors", ".xml")
"""Endings of the files that move numbers: code, settings, weights and SUMO nets."""

LEFT_OUT = (
    "__init__.py", "versions.py", "command_line.py", "tools.py", "rendering.py",
    "road_estimator.py", "measurement/seen.py", "importers/*", "_tools/*",
    "policies/*.safetensors",
)  # fmt: skip
"""Files of these kinds that move none. Results name a policy by a digest of its own."""

PLAYERS = ("environments.py", "play.py", "policies.py", "watchers.py")
"""Modules of ``agents`` that play cells; the others make cells, and tables of what was played."""

EQUAL = PACKAGE / "equal_digests.txt"
"""Declares digests equal: those on one line have the same numbers, and the first one's name."""


class SumoVersionError(RuntimeError):
    """The installed libsumo cannot make records; the message says why, and what to do."""


def sumo_version() -> str:
    """Return the version of the installed libsumo, without importing it.

    Raises:
        SumoVersionError: libsumo is missing or older than `TESTED_SUMO`.
    """
    version = installed("libsumo")
    if version is None:
        raise SumoVersionError(f"libsumo is not installed: pip install 'libsumo~={TESTED_SUMO}.0'")
    require_sumo(version)
    return version


def require_sumo(version: str) -> None:
    """Check a version of libsumo.

    Raises:
        SumoVersionError: It is older than `TESTED_SUMO`, or no version.
    """
    if release(version) < release(TESTED_SUMO):
        raise SumoVersionError(
            f"libsumo must be {TESTED_SUMO} or newer, found {version}: "
            f"pip install --force-reinstall 'libsumo~={TESTED_SUMO}.0'"
        )


def release(version: str) -> tuple[int, ...]:
    """Return the first two numbers of a version; none where it has none."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:2])


def installed(package: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 (slow to import)

    try:
        return version(package)
    except PackageNotFoundError:
        return None


def code_version() -> str:
    """Return the version of the package and, behind a plus, the digest of what moves its numbers.

    Raises:
        OSError: The package cannot be read.
    """
    return f"{__version__}+{digest()}"


def versions_with(*packages: str) -> dict[str, str]:
    """Return the versions of this code and of other packages, for a card.

    Raises:
        PackageNotFoundError: One is not installed.
    """
    from importlib.metadata import version  # noqa: PLC0415 (slow to import)

    return {"dptse-env": code_version(), **{name: version(name) for name in packages}}


def numbers_of(code: str) -> str:
    """Return the name of the numbers of a version: that of its digest, or of one equal to it.

    Rows from before there were digests have a version alone, which stands for its numbers.

    Raises:
        ValueError: `EQUAL` has a digest on two lines.
    """
    own = code.rpartition("+")[2]
    return equal_digests().get(own, own)


@cache
def equal_digests() -> Mapping[str, str]:
    """Return the name of the numbers of each digest that is declared.

    Raises:
        ValueError: A digest is on two lines.
    """
    names: dict[str, str] = {}
    for line in EQUAL.read_text(encoding="utf-8").splitlines():
        words = line.partition("#")[0].split()
        for word in words:
            if names.setdefault(word, words[0]) != words[0]:
                raise ValueError(f"{EQUAL}: digests must stand on one line, {word!r} is on two")
    return names


@cache
def digest() -> str:
    """Return 12 digits of the digest of this code and of the release of SUMO that it records with.

    It is the same in a wheel and in a checkout.
    """
    about = digest_of(PACKAGE, TOOLS), release(installed("libsumo") or "")
    return hashlib.sha256(repr(about).encode()).hexdigest()[:12]


def digest_of(package: Path, tools: Path) -> str:
    """Return 12 digits of the digest of a package, and of what plays among the tools.

    Comments, docstrings and layout do not count, nor does the version of Python.

    Args:
        package: Folder of the package.
        tools: Folder that has ``agents``.
    """
    found = hashlib.sha256()
    for name, path in sorted(_files(package, tools)):
        if path.suffix == ".py":
            content = _plain(ast.parse(path.read_bytes())).encode()
        elif path.suffix == ".safetensors":
            content = path.read_bytes()
        else:
            content = path.read_text(encoding="utf-8").encode()  # whatever ends its lines
        found.update(f"{name} {len(content)} ".encode() + content)
    return found.hexdigest()[:12]


def _files(package: Path, tools: Path) -> Iterator[tuple[str, Path]]:
    """Yield the files that move numbers, with names that do not depend on where they lie."""
    for path in package.rglob("*"):
        name = path.relative_to(package).as_posix()
        if path.suffix in KINDS and not any(fnmatchcase(name, each) for each in LEFT_OUT):
            yield name, path
    for path in (tools / "agents").glob("*.py"):
        if path.name in PLAYERS:
            yield f"agents/{path.name}", path


def _plain(node: Any) -> str:
    """Return a syntax tree as text without docstrings.

    What is empty is left out: versions of Python differ in it, as their `ast.dump` does.
    """
    if isinstance(node, ast.JoinedStr):
        parts = [each for each in node.values if getattr(each, "value", None) != ""]
        node = ast.JoinedStr(parts)
    if isinstance(node, ast.AST):
        text = type(node).__name__
        for name in node._fields:
            value = getattr(node, name, None)
            if value is not None and value != []:
                text += f" {name}={_plain(value)}"
        return f"({text})"
    if isinstance(node, list):
        return f"[{','.join(_plain(each) for each in node if not _is_text(each))}]"
    return repr(node)


def _is_text(node: Any) -> bool:
    """Return whether a statement is a string alone, as docstrings are."""
    if not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        return False
    return isinstance(node.value.value, str)
