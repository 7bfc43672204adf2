"""Compiled functions: what is kept on disk, when it is compiled anew, and what is said then."""

import importlib
import logging
import os
import pickle
import sys
import threading

import pytest
from numba.core import config

from dptse_env.utils import kernels
from dptse_env.utils.kernels import fingerprint

PAIR = """
class Pair(NamedTuple):
    first: float
    second: float
"""
MODULE = f"""
from typing import NamedTuple

from dptse_env.utils.kernels import kernel, kernel_part

FACTOR = 2.0

{PAIR}

@kernel_part
def scaled(x):
    return x * FACTOR


@kernel
def run(x):
    return Pair(scaled(x), x).first


@kernel
def second(pair):
    return pair.second
"""
LOG = "dptse_env.utils.kernels"


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Return an empty folder in which machine code is kept."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "kept"))
    return tmp_path / "kept"


@pytest.fixture
def load(tmp_path, monkeypatch, kept):
    """Return a function that writes a module, imports it afresh and returns it."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def load(text=MODULE, name="kernels_of_a_test"):
        path = tmp_path / f"{name}.py"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")  # else the file stays as old as it is
        monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        return importlib.import_module(name)

    return load


CHANGES = {
    "a part": ("x * FACTOR", "x + FACTOR"),
    "a constant": ("FACTOR = 2.0", "FACTOR = 3.0"),
    "a number in a part": ("x * FACTOR", "x * 5.0 * FACTOR"),
    "the kernel": (".first", ".second"),
    "a named tuple": ("second: float", "other: float"),
    "the name of a type": (PAIR, PAIR.replace("Pair", "Two") + "\n\nPair = Two\n"),
    "a default": ("def scaled(x)", "def scaled(x, y=1.0)"),
    "how a part is compiled": ("@kernel_part", '@kernel_part(fastmath={"contract", "nnan"})'),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_anything_that_a_kernel_reaches_changes_its_fingerprint(load, change):
    before = fingerprint(load().run.py_func)
    assert fingerprint(load("# A comment\n" + MODULE).run.py_func) == before
    assert fingerprint(load(MODULE.replace(*CHANGES[change])).run.py_func) != before


def test_equal_code_of_another_module_has_another_fingerprint(load):
    # Machine code imports the modules of what it was made from, one of which may be gone.
    before = fingerprint(load().second.py_func)
    assert fingerprint(load(name="elsewhere").second.py_func) != before


@pytest.fixture
def fresh(load):
    """Return a function that returns what a new kernel gives, and how much of it was kept."""

    def fresh(text=MODULE):
        run = load(text).run
        return run(1.5), sum(run.stats.cache_hits.values())

    return fresh


def test_a_kernel_is_kept_on_disk_and_compiled_anew_when_a_part_changes(fresh):
    usual = os.umask(0)  # others may write, where nothing else is said
    try:
        assert fresh() == (3.0, 0)
    finally:
        os.umask(usual)
    assert fresh() == (3.0, 1)
    assert fresh(MODULE.replace("FACTOR = 2.0", "FACTOR = 4.0")) == (6.0, 0)


class Harm:
    """An object that fails the test when it is unpickled."""

    def __reduce__(self):
        return pytest.fail, ("it was unpickled",)


DAMAGES = {
    "cut": lambda content, _: content[:-1],
    "flipped": lambda content, _: content[:999] + bytes([content[999] ^ 1]) + content[1000:],
    "empty": lambda *_: b"",
    "another file's": lambda _, other: other,
    "foreign": lambda *_: pickle.dumps(Harm()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_made_again_and_not_unpickled(fresh, kept, damage, caplog):
    fresh(MODULE.replace("FACTOR = 2.0", "FACTOR = 4.0"))
    (other,) = kept.iterdir()
    fresh()
    (file,) = set(kept.iterdir()) - {other}
    file.write_bytes(DAMAGES[damage](file.read_bytes(), other.read_bytes()))
    assert fresh() == (3.0, 0)
    assert caplog.messages == [f"{file} is damaged, or others can write to it: it is made again"]
    assert fresh() == (3.0, 1)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such modes")
@pytest.mark.parametrize("right", [0o020, 0o002])
def test_machine_code_that_others_can_write_to_is_not_used(fresh, kept, right, caplog, monkeypatch):
    fresh()
    (file,) = kept.iterdir()
    file.chmod(0o600 | right)
    assert fresh() == (3.0, 0)
    assert fresh() == (3.0, 1)  # it is made again
    caplog.clear()
    kept.chmod(0o700 | right)
    assert fresh() == fresh() == (3.0, 0)
    kept.chmod(0o700)
    assert fresh() == (3.0, 1)
    monkeypatch.setattr(os, "getuid", lambda: kept.stat().st_uid + 1)
    assert fresh() == (3.0, 0)
    assert caplog.messages == [
        f"{kept} cannot keep machine code (others can write to it): "
        "set NUMBA_CACHE_DIR to a folder that only you can write to"
    ]


def test_machine_code_is_that_of_the_types_of_arguments(load):
    """The code of the kernel does not name them."""
    fields = "first: float\n    second: float"
    turned = MODULE.replace(fields, "second: float\n    first: float")
    another = MODULE.replace("Pair", "Two")
    for text, name, second in (
        (MODULE, "Pair", 2.5),
        (turned, "Pair", 1.5),
        (another, "Two", 2.5),  # the type before it is no more
    ):
        module = load(text)
        assert module.second(getattr(module, name)(1.5, 2.5)) == second


def test_a_kernel_runs_where_no_folder_can_keep_it_and_says_so(load, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "file" / "kept"))
    with caplog.at_level(logging.WARNING, logger=LOG):
        module = load()
        assert module.run(1.5) == 3.0
        assert module.second(module.Pair(1.5, 2.5)) == 2.5
    assert caplog.text.count("set NUMBA_CACHE_DIR to a folder") == 1


@pytest.fixture
def said(monkeypatch, caplog):
    """Return what is said of compiling, where all kernels are slow."""
    monkeypatch.setattr(kernels, "_SLOW", "")
    monkeypatch.setattr(kernels, "compiling_is_said", threading.Event())
    caplog.set_level(logging.WARNING, logger=LOG)
    return caplog


def test_compiling_what_is_slow_is_said_once(load, kept, said, monkeypatch):
    module = load()
    module.run(1.5)
    module.second(module.Pair(1.5, 2.5))
    assert said.messages == [
        "Compiling the estimator, once on this machine: about 10 s, the MHE 25 s"
    ]
    said.clear()
    kernels.compiling_is_said.clear()
    load().run(1.5)  # which is kept
    monkeypatch.setattr(kernels, "_SLOW", "other")
    load(MODULE.replace("2.0", "4.0")).run(1.5)  # which is quick
    assert not said.messages


def test_a_part_has_one_version_for_constants_and_variables(load):
    text = MODULE.replace("Pair(scaled(x), x).first", "scaled(x) + scaled(1.0) + scaled(2.0)")
    module = load(text)
    assert module.run(1.5) == 9.0
    assert len(module.scaled.overloads) == 1
