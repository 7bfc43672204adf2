import io
import operator
import os
import signal
import subprocess
import sys
import threading
import warnings
from concurrent.futures import Future
from typing import ClassVar

import loky
import pytest

from agents.executors import (
    ExecutorError,
    make_executor,
    run_in_order,
    run_shown,
    this_process,
)
from dptse_env.utils.kernels import compiling_is_said
from dptse_env.utils.registry import MissingExtraError
from tests.helpers import ROOT, wait_for


def reciprocal(number):
    return 1 / number


@pytest.mark.parametrize("workers", [1, 2])
def test_tasks_come_back_with_their_results_and_errors_as_they_are(workers):
    executor = make_executor("local", workers)
    assert run_in_order(executor, operator.neg, range(300, 306)) == [-k for k in range(300, 306)]
    assert run_in_order(executor, operator.neg, []) == []
    assert run_in_order(executor, operator.neg, [1, 1, 2, 1]) == [-1, -1, -2, -1]
    with pytest.raises(ZeroDivisionError):
        run_in_order(executor, reciprocal, [1, 0, 2])


def test_results_are_in_the_order_of_the_tasks_whichever_is_done_first():
    def backwards(work, tasks):
        yield from list(enumerate(map(work, tasks)))[::-1]

    assert run_in_order(backwards, operator.neg, [1, 2, 3]) == [-1, -2, -3]


def test_a_result_is_handed_over_before_the_next_task_begins_and_the_bar_has_its_size():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    seen, bar = [], Terminal()

    def work(task):
        seen.append(("begun", task))
        return -len(task)

    tasks = [range(2), range(3)]
    run_shown(this_process, work, tasks, lambda *done: seen.append(done), size=len, file=bar)
    assert seen == [("begun", range(2)), (0, -2), ("begun", range(3)), (1, -3)]
    assert "5/5" in bar.getvalue()


def meet(folder):
    """Wait for another process that does the same; return this one."""
    (folder / str(os.getpid())).touch()
    wait_for(lambda: len(list(folder.iterdir())) >= 2)
    return os.getpid()


def interrupted(number):
    os.kill(os.getpid(), signal.SIGTERM if number else signal.SIGINT)
    return number


def test_there_are_as_many_processes_as_asked_for_and_they_leave_interrupts_to_this_one(tmp_path):
    executor = make_executor("local", 2)
    places = run_in_order(executor, meet, [tmp_path] * 8)
    assert {str(place) for place in places} == {each.name for each in tmp_path.iterdir()}
    assert len({*places} - {os.getpid()}) == 2
    assert run_in_order(executor, interrupted, range(2)) == [0, 1]


def n_warnings(module):
    with warnings.catch_warnings(record=True) as given:
        warnings.warn_explicit("again", UserWarning, "file.py", 1, module)
    return len(given)


def is_said(_):
    return compiling_is_said.is_set()


def test_processes_have_one_thread_and_do_not_repeat_what_this_one_has_said(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    said = threading.Event()
    said.set()
    monkeypatch.setattr("agents.executors.compiling_is_said", said)
    executor = make_executor("local", 2)
    assert run_in_order(executor, n_warnings, ["dptse_env.config", "torch"]) == [0, 1]
    assert run_in_order(executor, is_said, [1]) == [True]
    assert run_in_order(executor, os.getenv, ["OMP_NUM_THREADS"]) == ["1"]


def test_tasks_run_in_the_folder_of_this_process(tmp_path, monkeypatch):
    executor = make_executor("local", 2)
    for folder in (tmp_path, tmp_path.parent):
        monkeypatch.chdir(folder)
        assert run_in_order(executor, os.path.realpath, ["a"]) == [os.path.realpath("a")]


def test_a_task_whose_worker_died_runs_again_three_times(monkeypatch):
    """With processes in this one, which die as often as they should."""

    class Mortal:
        deaths: ClassVar = {-1: 3, -2: 6}

        def submit(self, work, task):
            future = Future()
            if self.deaths.get(task):
                self.deaths[task] -= 1
                future.set_exception(loky.BrokenProcessPool())
            else:
                future.set_result(work(task))
            return future

    pool, executor = Mortal(), make_executor("local", 2)
    monkeypatch.setattr(loky, "get_reusable_executor", lambda *_, **__: pool)
    assert run_in_order(executor, abs, [-1, -2]) == [1, 2]  # three times after the last result
    pool.deaths[-2] = 4
    with pytest.raises(ExecutorError, match="a task was lost 4 times"):
        run_in_order(executor, abs, [1, -2])
    assert pool.deaths[-2] == 0


PROGRAM = """
import sys
from agents.executors import make_executor, run_in_order
run_in_order(make_executor("local", 2), exec, sys.argv[1:])
"""
TASK = """
import os, pathlib, time
folder = pathlib.Path({folder!r})
(folder / str(os.getpid())).touch()
while {forever} or len(list(folder.iterdir())) < 2:
    time.sleep(0.01)
1 / 0
"""


@pytest.mark.parametrize("one_fails", [False, True])
def test_what_still_runs_is_ended_where_another_fails_or_the_program_is_killed(tmp_path, one_fails):
    tasks = [TASK.format(folder=str(tmp_path), forever=each) for each in (True, not one_fails)]
    command = [sys.executable, "-c", PROGRAM, *tasks]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as program:
        try:
            if not one_fails:
                wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
                program.kill()
            # The pipe is open as long as there is any process.
            assert ("ZeroDivisionError" in program.communicate(timeout=300)[1]) == one_fails
        finally:
            program.kill()


def test_one_worker_is_the_calling_process():
    assert run_in_order(make_executor("local", 1), lambda _: os.getpid(), [0]) == [os.getpid()]
    for workers in (0, 1.5):
        with pytest.raises(ValueError, match="workers must be an integer >= 1"):
            make_executor("local", workers)


def test_an_address_belongs_to_a_cluster():
    with pytest.raises(ValueError, match="address must be given with the executor ray, got 'auto'"):
        make_executor("local", 1, "auto")


def test_the_extra_is_named_where_ray_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'dptse-env\[ray\]'"):
        make_executor("ray", 1)
