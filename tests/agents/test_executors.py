import operator
import os
import signal
import sys
import time
import warnings

import pytest

from agents.executors import (
    ExecutorError,
    LocalProcesses,
    ThisProcess,
    make_executor,
    run_in_order,
    run_shown,
)
from dptse_env.utils.kernels import compiling_is_said
from dptse_env.utils.registry import MissingExtraError


def run(executor, work, tasks):
    return run_in_order(executor, work, tasks, progress=False)


def reciprocal(number):
    return 1 / number


@pytest.mark.parametrize("kind", [ThisProcess, lambda: LocalProcesses(2)])
def test_tasks_come_back_with_their_results_and_errors_as_they_are(kind):
    executor, done = kind(), []
    assert run(executor, operator.neg, range(9)) == [-k for k in range(9)]
    assert run(executor, operator.neg, []) == []
    assert run_in_order(executor, operator.neg, [3, 1], done.append, progress=False) == [-3, -1]
    assert done == [0.5, 1.0]
    with pytest.raises(ZeroDivisionError):
        run(executor, reciprocal, [1, 0, 2])


def test_a_result_is_handed_over_before_the_next_task_begins():
    seen = []

    def work(number):
        seen.append(("begun", number))
        return number

    run_shown(ThisProcess(), work, [1, 2], lambda task, _: seen.append(("taken", task)))
    assert seen == [("begun", 1), ("taken", 1), ("begun", 2), ("taken", 2)]


def place(number):
    time.sleep(0.1)
    return os.getpid()


def interrupted(number):
    os.kill(os.getpid(), signal.SIGINT)
    return number


def test_there_are_as_many_processes_as_asked_for_and_they_leave_interrupts_to_this_one():
    executor = LocalProcesses(2)
    places = set(run(executor, place, range(8)))
    assert len(places) <= 2
    assert os.getpid() not in places
    assert run(executor, interrupted, range(2)) == [0, 1]


def n_warnings(module):
    with warnings.catch_warnings(record=True) as given:
        warnings.warn_explicit("again", UserWarning, "file.py", 1, module)
    return len(given)


def is_said(_):
    return compiling_is_said.is_set()


def test_processes_do_not_repeat_what_this_one_has_said():
    assert run(LocalProcesses(2), n_warnings, ["dptse_env.config", "torch"]) == [0, 1]
    compiling_is_said.set()
    assert run(LocalProcesses(2), is_said, [1]) == [True]


def dies(number):
    if number == 3:
        os.kill(os.getpid(), 9)
    time.sleep(0.01)
    return number


def dies_once(task):
    number, trace = task
    if number == 3 and not trace.exists():
        trace.touch()
        os.kill(os.getpid(), 9)
    return number


@pytest.mark.slow
def test_a_task_whose_worker_died_runs_again_three_times(tmp_path):
    tasks = [(number, tmp_path / "trace") for number in range(8)]
    assert run(LocalProcesses(2), dies_once, tasks) == list(range(8))
    with pytest.raises(ExecutorError, match="a task was lost 4 times"):
        run(LocalProcesses(2), dies, range(8))
    assert run(LocalProcesses(2), abs, [-1]) == [1]


@pytest.mark.slow
def test_an_error_ends_what_still_runs():
    start = time.monotonic()
    with pytest.raises(ZeroDivisionError):
        run(LocalProcesses(2), sleep_or_fail, [0.0, *[60.0] * 5])
    assert time.monotonic() - start < 30.0


def sleep_or_fail(seconds):
    time.sleep(seconds)
    return 1 / seconds


@pytest.mark.parametrize("workers", [0, 1.5])
def test_the_number_of_processes_is_checked(workers):
    with pytest.raises(ValueError, match="workers must be an integer >= 1"):
        make_executor("local", workers)


def test_an_address_belongs_to_a_cluster():
    with pytest.raises(ValueError, match="address must be given with the executor ray, got 'auto'"):
        make_executor("local", 1, "auto")


def test_the_extra_is_named_where_ray_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'dptse-env\[ray\]'"):
        make_executor("ray", 1)
