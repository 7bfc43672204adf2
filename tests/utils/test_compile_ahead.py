"""Compiling in other processes: whose turn it is, what the list says, and children that fail."""

import inspect
import logging
import subprocess
import sys
import time
from pkgutil import resolve_name

import pytest
from filelock import FileLock
from numba.core.registry import CPUDispatcher

from dptse_env.utils import compile_ahead, kernel_list, python_process
from dptse_env.utils.kernels import compile_unless_busy
from tests.kernel_list import ESTIMATORS, compiled_afresh

from .test_kernels import MODULE, kept, load

__all__ = ["kept", "load"]  # fixtures

LOG = "dptse_env.utils.compile_ahead"


# --- the list ---------------------------------------------------------------------------------


def test_every_entry_of_the_list_fits_its_function():
    for path, signature in (each for name in ESTIMATORS for each in kernel_list.listed(name)):
        function = resolve_name(path)
        assert isinstance(function, CPUDispatcher)
        assert len(signature) == len(inspect.signature(function.py_func).parameters), path
        for kind in signature:
            fields = getattr(kind, "fields", None)  # of a named tuple
            assert fields is None or fields == kind.instance_class._fields, path


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_list_is_what_a_first_step_compiles(estimator):
    assert compiled_afresh(estimator) == kernel_list.listed(estimator)


def test_a_list_survives_its_file():
    lists = {name: list(kernel_list.listed(name)) for name in ESTIMATORS}
    text = kernel_list.written(lists)
    assert text == kernel_list.PATH.read_text(encoding="utf-8")
    assert kernel_list.read(text, "mhe") == tuple(lists["mhe"])
    assert kernel_list.read(text, "random_walk") == ()


# --- turns ------------------------------------------------------------------------------------


HOLD = """
import sys, time
from filelock import FileLock
with FileLock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def hold(path, seconds):
    """Hold a lock in another process."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path), str(seconds)], stdout=subprocess.PIPE
    )
    assert process.stdout.readline() == b"held\n"
    return process


@pytest.mark.slow
def test_a_function_that_another_process_compiles_is_waited_for(load, tmp_path, caplog):
    run = load().run
    path = tmp_path / "kernels_of_a_test.run.lock"
    with hold(path, 2.0), caplog.at_level(logging.WARNING, logger=LOG):
        assert compile_ahead.is_taken(run.py_func, tmp_path)
        began = time.monotonic()
        compile_ahead.take_turn(run.py_func, tmp_path).release()
        assert time.monotonic() - began > 0.5
    assert "Waiting for another process, which compiles kernels_of_a_test:run" in caplog.text
    assert not compile_ahead.is_taken(run.py_func, tmp_path)


@pytest.mark.slow
def test_a_child_leaves_out_what_another_process_compiles(load):
    run = load().run
    signature = (kernel_list._read("float64", {}),)
    with hold(f"{run._cache.cache_path}/kernels_of_a_test.run.lock", 5.0) as other:
        compile_unless_busy(run, signature)
        assert not run.signatures
        other.kill()
    compile_unless_busy(run, signature)
    assert run.signatures == [signature]


def test_the_turn_ends_where_compiling_fails(load):
    run = load(MODULE.replace("x * FACTOR", "x.nothing")).run
    for _ in range(2):
        with pytest.raises(Exception, match="nothing"):
            run(1.5)
    assert not run._cache.is_busy()


def test_a_folder_without_locks_is_compiled_into_all_the_same(load, monkeypatch, caplog):
    def acquire(*_, **__):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(FileLock, "acquire", acquire)
    module = load()
    with caplog.at_level(logging.WARNING, logger=LOG):
        assert module.run(1.5) == 3.0
        assert module.run(1) == 2.0
    assert caplog.text.count("takes no locks") == 1


# --- children ---------------------------------------------------------------------------------


@pytest.fixture
def started(load, monkeypatch):
    """Return a function that compiles a listed kernel for the first time."""
    module = load()
    path = "kernels_of_a_test:run"
    entry = kernel_list.Listed(path, (kernel_list._read("float64", {}),))
    monkeypatch.setattr(kernel_list, "listed", lambda estimator: (entry,))
    monkeypatch.setattr(compile_ahead, "_expected", ["mine"])
    monkeypatch.setenv(compile_ahead.PROCESSES_VARIABLE, "1")
    return module.run


def said(caplog):
    return [record.getMessage() for record in caplog.records if record.name == LOG]


def wait_for(condition):
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_a_child_that_fails_is_survived_and_reported(started, monkeypatch, caplog):
    monkeypatch.setattr(compile_ahead, "CHILD", "dptse_env.utils.no_such_module")
    with caplog.at_level(logging.WARNING, logger=LOG):
        assert started(1.5) == 3.0
        wait_for(lambda: "ended with code 1" in caplog.text)
    assert "Compiling what 'mine' needs next in 1 more process" in caplog.text
    assert "no_such_module" in caplog.text


@pytest.mark.slow
def test_only_one_process_starts_children(started, caplog):
    lock = FileLock(f"{started._cache.cache_path}/compile_ahead.lock", thread_local=False)
    with (
        hold(lock.lock_file, 5.0) as other,
        caplog.at_level(logging.WARNING, logger=LOG),
    ):
        assert started(1.5) == 3.0
        other.kill()
    assert not said(caplog)


def test_no_child_is_started_where_none_is_asked_for(started, monkeypatch, caplog):
    monkeypatch.setenv(compile_ahead.PROCESSES_VARIABLE, "1.5")
    with pytest.raises(ValueError, match="DPTSE_COMPILE_PROCESSES must be a whole number"):
        started(1.5)
    monkeypatch.setenv(compile_ahead.PROCESSES_VARIABLE, "0")
    with caplog.at_level(logging.WARNING, logger=LOG):
        assert started(1.5) == 3.0
    assert not said(caplog)


@pytest.mark.slow
def test_a_child_ends_with_its_parent():
    child = subprocess.Popen(
        [*python_process.command(compile_ahead.CHILD), "mhe"],
        stdin=subprocess.PIPE,
        env=python_process.environment() | {"NUMBA_DISABLE_JIT": "0"},
    )
    child.stdin.close()
    child.wait(timeout=30.0)
