import contextlib
import gc
import operator
import sys
import time
import weakref

import pytest

from agents.engines.choice import make_engine
from agents.engines.engine import run_tasks
from agents.engines.local import LocalProcesses
from dptse_env.utils.extras import MissingExtraError


def slow_negative(number):
    time.sleep(0.05)
    return -number


@pytest.mark.parametrize("workers", [1, 2])
def test_tasks_come_back_with_their_results(workers):
    results = dict(run_tasks(LocalProcesses(workers), operator.neg, range(9)))
    assert results == {number: -number for number in range(9)}


@pytest.mark.parametrize("workers", [1, 2])
def test_no_task_at_all_is_no_work(workers):
    assert list(run_tasks(LocalProcesses(workers), operator.neg, [])) == []


@pytest.mark.parametrize(("workers", "ahead"), [(1, 1), (2, 4)])
def test_tasks_are_taken_as_workers_come_free(workers, ahead):
    taken = []
    numbers = (taken.append(number) or number for number in range(40))
    for done, _ in enumerate(run_tasks(LocalProcesses(workers), slow_negative, numbers), start=1):
        # Results that came meanwhile are replaced only when the next one is asked for.
        assert len(taken) - done < ahead + workers


class Task:
    """Stands for a task; it can be watched."""

    def __init__(self, number):
        self.number = number


def number_of(task):
    return task.number


def test_nothing_is_kept_of_a_task_that_is_done():
    alive = weakref.WeakSet()

    def tasks():
        for number in range(200):
            task = Task(number)
            alive.add(task)
            yield task

    most = 0
    for _ in run_tasks(LocalProcesses(1), number_of, tasks()):
        gc.collect()
        most = max(most, len(alive))
    assert most <= 3


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_a_task_is_raised_as_it_is(workers):
    with pytest.raises(ZeroDivisionError):
        list(run_tasks(LocalProcesses(workers), reciprocal, [1, 0, 2]))


def reciprocal(number):
    return 1 / number


def test_places_are_told_when_they_change():
    class Moving(LocalProcesses):
        @contextlib.contextmanager
        def open(self):
            places = iter(["", "2 nodes", "2 nodes", "3 nodes", "3 nodes"])

            class Workers:
                capacity = 1
                now = next(places)

                @property
                def place(self):
                    return self.now

                def submit(self, work, task):
                    Workers.now = next(places)
                    return inline.submit(work, task)

            with super().open() as inline:
                yield Workers()

    told = []
    list(run_tasks(Moving(1), operator.neg, range(3), told.append))
    assert told == ["2 nodes", "3 nodes"]


@pytest.mark.parametrize("workers", [0, -1, 1.5])
def test_the_number_of_processes_is_checked(workers):
    with pytest.raises(ValueError, match="workers must be an integer >= 1"):
        make_engine("local", workers, None)


def test_an_address_belongs_to_a_cluster():
    with pytest.raises(ValueError, match="address must be given with the engine ray, got 'auto'"):
        make_engine("local", 1, "auto")


def test_the_extra_is_named_where_ray_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "agents.engines.ray_cluster", raising=False)
    with pytest.raises(MissingExtraError, match=r"pip install 'dptse-env\[ray\]'"):
        make_engine("ray", 1, None)
