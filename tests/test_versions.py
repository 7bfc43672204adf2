"""The digest in versions follows what moves numbers, and nothing else."""

from pathlib import Path

import pytest

import dptse_env
from dptse_env import versions

EVERY_SYNTAX = '''
from __future__ import annotations

class Part(Base, key=1):
    """A docstring."""
    field: int = 3
    """Another one."""

    @property
    def value(self, a, /, b: float = -1.5e-3, *rest, c=None, **more) -> "int | None":
        return None if not a else (f"{a!r:>{b}} and {{c}}" "two", rb"\\x00")

async def call(x):
    async with x as y, y:
        await x; [i async for i in y if i]
    return {**x, "k": {1, 2}, 'l': (*x,)}

def empty():
    """Nothing but text."""

try:
    match x:
        case [1, *others] | {"k": Point(y=0), **others} if (n := len(x)) > 2: pass
        case _: ...
except* (OSError, ValueError) as problem:
    raise problem from None
lambda a, *b, k=1j: (yield a[::2, ..., 1:]) if a < b <= 3 is not True else 0xFFFFFFFFFFFFFFFFFF
'''


@pytest.fixture
def folder(tmp_path):
    """A folder with a small package and tools."""
    for name, text in {
        "package/step.py": EVERY_SYNTAX,
        "package/rendering.py": "a = 1\n",
        "package/importers/read.py": "a = 1\n",
        "package/tuned.json": "{}\n",
        "package/nets/net.safetensors": "weights",
        "package/policies/one.safetensors": "weights",
        "agents/play.py": "a = 1\n",
        "agents/page.py": "a = 1\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8", newline="")
    return tmp_path


def digest(folder):
    return versions.digest_of(folder / "package", folder)


def test_every_version_of_python_gives_the_same_digest(folder):
    assert digest(folder) == "e62759696cce"


def test_the_digest_stays_where_numbers_do(folder):
    first = digest(folder)
    for name, text in {
        "package/step.py": EVERY_SYNTAX.replace('    """A docstring."""\n', "    # a comment\n\n")
        .replace('"""Another one."""', '"""One."""')
        .replace("(OSError, ValueError)", "(\n    OSError,\n    ValueError,\n)"),
        "package/rendering.py": "a = 2\n",
        "package/importers/read.py": "a = 2\n",
        "package/tuned.json": "{}\r\n",
        "package/policies/one.safetensors": "heights",
        "package/notes.txt": "a",
        "agents/page.py": "a = 2\n",
    }.items():
        (folder / name).write_text(text, encoding="utf-8", newline="")
    assert digest(folder) == first


def test_the_digest_moves_with_the_release_of_sumo(monkeypatch):
    digests = []
    for version in ("1.28.0", "1.28.3", "1.29.0", "2.28.0", None):
        monkeypatch.setattr(versions, "installed", lambda package, found=version: found)
        digests.append(versions.digest.__wrapped__())
    assert digests[0] == digests[1]
    assert len(set(digests)) == 4


def test_the_package_has_no_other_kinds_of_files():
    files = Path(dptse_env.__file__).parent.rglob("*.*")
    kinds = {path.suffix for path in files if path.is_file()} - {".pyc"}
    assert kinds == {*versions.KINDS, ".txt", ".typed"}


def test_numbers_have_the_first_name_on_their_line(tmp_path, monkeypatch):
    file = tmp_path / "equal.txt"
    file.write_text("# names\n0.2.0 aaa  # played before\n\nbbb ccc\n")
    monkeypatch.setattr(versions, "EQUAL", file)
    monkeypatch.setattr(versions, "equal_digests", versions.equal_digests.__wrapped__)
    found = {each: versions.numbers_of(each) for each in ("0.2.0", "1+aaa", "2+ccc", "2+d", "0.1")}
    assert found == {"0.2.0": "0.2.0", "1+aaa": "0.2.0", "2+ccc": "bbb", "2+d": "d", "0.1": "0.1"}
    file.write_text("a b\nc b\n")
    with pytest.raises(ValueError, match=r"equal\.txt: .*'b' is on two"):
        versions.numbers_of("a")
