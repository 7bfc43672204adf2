import operator
import os
import sys
import time

import pytest

from agents.executors import (
    ExecutorError,
    LocalProcesses,
    ThisProcess,
    make_executor,
    run_in_order,
    run_tasks,
)
from dptse_env.utils.registry import MissingExtraError


@pytest.fixture(scope="module")
def processes():
    made = LocalProcesses(2)
    yield made
    made.shutdown()


@pytest.mark.parametrize("kind", ["this process", "processes"])
def test_tasks_come_back_with_their_results_and_errors_as_they_are(kind, processes):
    executor = ThisProcess() if kind == "this process" else processes
    assert dict(run_tasks(executor, operator.neg, range(9))) == {k: -k for k in range(9)}
    assert list(run_tasks(executor, operator.neg, [])) == []
    done = []
    assert run_in_order(executor, operator.neg, [3, 1, 2], done.append, progress=False) == [
        -3, -1, -2,
    ]  # fmt: skip
    assert done[-1] == 1.0
    with pytest.raises(ZeroDivisionError):
        list(run_tasks(executor, reciprocal, [1, 0, 2]))


def reciprocal(number):
    return 1 / number


def test_tasks_are_taken_as_workers_come_free():
    taken = []
    numbers = (taken.append(number) or number for number in range(20))
    for done, _ in enumerate(run_tasks(ThisProcess(), operator.neg, numbers), start=1):
        assert len(taken) - done <= 1


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
def test_a_task_whose_worker_died_runs_again(processes, tmp_path):
    tasks = [(number, tmp_path / "trace") for number in range(8)]
    assert sorted(number for _, number in run_tasks(processes, dies_once, tasks)) == list(range(8))


@pytest.mark.slow
def test_a_task_is_given_up_when_four_workers_died(processes):
    with pytest.raises(ExecutorError, match="a task was lost 4 times"):
        list(run_tasks(processes, dies, range(8)))
    assert dict(run_tasks(processes, abs, [-1])) == {-1: 1}


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
