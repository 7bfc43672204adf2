import io
import operator
import os
import signal
import subprocess
import sys
import threading
import warnings
from concurrent.futures import Future
from pathlib import Path

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
from tests.helpers import ROOT, wait_for


def reciprocal(number):
    return 1 / number


def test_one_worker_is_the_calling_process_and_errors_come_as_they_are():
    executor = make_executor("local", 1)
    assert run_in_order(executor, lambda _: os.getpid(), [0]) == [os.getpid()]
    assert run_in_order(executor, operator.neg, []) == []
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


def here(places):
    """Wait until two processes are here, and return what this one is like."""
    Path(places, str(os.getpid())).touch()
    wait_for(lambda: len([*Path(places).iterdir()]) >= 2)
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(os.getpid(), number)
    with warnings.catch_warnings(record=True) as given:
        for module in ("dptse_env.config", "torch"):
            warnings.warn_explicit("again", UserWarning, "file.py", 1, module)
    return os.getpid(), os.getenv("OMP_NUM_THREADS"), len(given), compiling_is_said.is_set()


def test_processes_are_as_many_as_asked_for_and_leave_interrupts_and_messages_to_this_one(
    tmp_path, monkeypatch
):
    said = threading.Event()
    said.set()
    monkeypatch.setattr("agents.executors.compiling_is_said", said)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "places").mkdir()
    executor = make_executor("local", 2)
    found = run_in_order(executor, here, ["places"] * 8)
    places, *others = map(set, zip(*found, strict=True))
    assert places == {int(path.name) for path in Path("places").iterdir()}
    assert len(places - {os.getpid()}) == 2
    assert others == [{"1"}, {1}, {True}]
    assert run_in_order(executor, operator.neg, [300, 1, 300, 2]) == [-300, -1, -300, -2]
    with pytest.raises(ZeroDivisionError):
        run_in_order(executor, reciprocal, [1, 0, 2])
    monkeypatch.chdir("places")
    assert run_in_order(executor, os.path.realpath, ["a"]) == [os.path.realpath("a")]


class Mortal:
    """Processes in this one, which die as often as they should."""

    def __init__(self, **deaths):
        self.deaths, self.ended = deaths, []

    def submit(self, work, task):
        future = Future()
        try:
            if self.deaths.get(task):
                self.deaths[task] -= 1
                raise loky.BrokenProcessPool
            future.set_result(work(task))
        except Exception as problem:
            future.set_exception(problem)
        return future

    def shutdown(self, **how):
        self.ended.append(how)


def test_a_task_whose_worker_died_runs_again_three_times(monkeypatch):
    pool, executor = Mortal(a=3, b=6), make_executor("local", 2)
    monkeypatch.setattr(loky, "get_reusable_executor", lambda *_, **__: pool)
    assert run_in_order(executor, ord, "ab") == [97, 98]  # three times after the last result
    pool.deaths["b"] = 4
    with pytest.raises(ExecutorError, match="a task was lost 4 times"):
        run_in_order(executor, ord, "cb")
    assert pool.deaths["b"] == 0
    assert not pool.ended
    with pytest.raises(TypeError):  # what still runs is ended where another fails
        run_in_order(executor, ord, ["a", "bc"])
    assert pool.ended == [{"kill_workers": True}]


PROGRAM = """
import sys
from agents.executors import make_executor, run_in_order
run_in_order(make_executor("local", 2), exec, sys.argv[1:])
"""
TASK = """
import os, pathlib, time
folder = pathlib.Path({folder!r})
(folder / str(os.getpid())).touch()
while True:
    time.sleep(0.01)
"""


@pytest.mark.slow
def test_what_still_runs_is_ended_where_the_program_is_killed(tmp_path):
    command = [sys.executable, "-c", PROGRAM, *[TASK.format(folder=str(tmp_path))] * 2]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as program:
        try:
            wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
            program.kill()
            program.communicate(timeout=300)  # the pipe is open as long as there is any process
        finally:
            program.kill()


def test_what_an_interruption_leaves_is_removed_without_a_word():
    left = "import loky.backend.resource_tracker as own\nown.register('/left', 'semlock')"
    command = [sys.executable, "-c", f"{PROGRAM}{left}", "1", "2"]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stderr == b""


def test_an_address_is_for_ray_alone():
    with pytest.raises(ValueError, match=r"address must be .* got 'auto'"):
        make_executor("local", 1, "auto")
