import contextlib
import dataclasses
import multiprocessing
import os
import signal
import time
from concurrent.futures import Future
from pathlib import Path

import pytest

from agents.engines.engine import run_tasks
from agents.engines.local import LocalProcesses, follow_parent
from agents.evaluation.episodes import EpisodeScore, run_episode
from agents.experiments.ledger import Ledger
from agents.experiments.runner import EpisodeTask, make_env, missing_tasks, run_task
from agents.experiments.tasks import run_all
from agents.studies.paper.plan import SETTINGS, PaperCell, PaperDesign
from dptse_env.config import resolve
from dptse_env.schedules import make_schedule
from dptse_env.traffic import RecordLibrary

SHORT = "dptse_env:dptse/ShortHighway-v0"
SEEDS = (2000, 2001)
EKF = PaperCell("ekf", "w99-3lane", "paper", 1.0, 0.05, 2)
WALK = dataclasses.replace(EKF, estimator="random_walk")


def task_of(cell):
    return EpisodeTask(SHORT, "paper", cell, cell.keywords, SEEDS, None)


TASKS = [task_of(EKF), task_of(WALK)]


@pytest.fixture(autouse=True, scope="module")
def _records():
    RecordLibrary().ensure(resolve("short-highway", {}).corridor, SEEDS)


@pytest.fixture
def ledger(tmp_path):
    return Ledger(tmp_path / "episodes.csv", PaperCell, EpisodeScore)


def test_a_task_is_a_cell_on_its_seeds():
    scores = run_task(TASKS[0])
    assert [score.traffic_seed for score in scores] == list(SEEDS)
    assert scores[0].rmse_density != scores[1].rmse_density
    env = make_env(SHORT, EKF.keywords, SEEDS, None)
    schedule = make_schedule("paper", env)
    assert scores == [run_episode(env, schedule, traffic_seed=k, seed=k) for k in SEEDS]
    assert scores[1] != run_episode(env, schedule, traffic_seed=2001, seed=2000)
    assert run_task(dataclasses.replace(TASKS[0], seeds=(2001,))) == scores[1:]


def test_noise_alone_moves_what_differs_in_noise_alone():
    other = task_of(dataclasses.replace(EKF, privacy="corrected"))
    for less, more in zip(run_task(TASKS[0]), run_task(other), strict=True):
        assert less.rmse_density < more.rmse_density


def test_the_open_loop_does_not_depend_on_what_its_canonical_cell_leaves_out():
    first = PaperCell("open_loop", "paper", "paper", 1.0, 0.05, 1)
    second = PaperCell("open_loop", "paper", "corrected", 0.1, 0.01, 3)
    scores = [run_task(task_of(cell)) for cell in (first, second)]
    assert scores[0] == scores[1]


def test_workers_find_what_this_process_finds(ledger, tmp_path):
    run_all(TASKS, ledger, LocalProcesses(2), run_task, progress=False)
    alone = Ledger(tmp_path / "alone.csv", PaperCell, EpisodeScore)
    run_all(TASKS, alone, LocalProcesses(1), run_task, progress=False)
    assert ledger.rows == alone.rows
    assert set(ledger.rows) == {(cell, seed) for cell in (EKF, WALK) for seed in SEEDS}
    assert ledger.path.read_bytes() == alone.path.read_bytes()


class Backwards:
    """An engine of another kind, and its workers: two tasks at once, of which the first is late."""

    is_parallel, capacity, place = False, 2, "elsewhere"

    @contextlib.contextmanager
    def open(self):
        self.late = []
        yield self

    def submit(self, work, task):
        future = Future()
        self.late.append((future, work, task))
        if len(self.late) == 2:
            for late, its_work, its_task in reversed(self.late):
                late.set_result(its_work(its_task))
        return future


def test_any_engine_fills_a_ledger(ledger, tmp_path):
    run_all(TASKS, ledger, Backwards(), run_task, progress=False)
    alone = Ledger(tmp_path / "alone.csv", PaperCell, EpisodeScore)
    run_all(TASKS, alone, LocalProcesses(1), run_task, progress=False)
    assert ledger.path.read_bytes() == alone.path.read_bytes()


def test_a_failure_in_a_worker_is_raised_and_leaves_no_process(ledger):
    bad = task_of(dataclasses.replace(EKF, bandwidth=99))
    with pytest.raises(ValueError, match="bandwidth must be in"):
        run_all([bad, *TASKS], ledger, LocalProcesses(2), run_task, progress=False)
    assert multiprocessing.active_children() == []


def wait_for_ever(seconds):
    """Take as long as it is told; leave a file that says how it ended."""
    if seconds:
        folder = Path(os.environ["ENDS"])
        (folder / str(os.getpid())).write_text("begun")
        time.sleep(seconds)
        (folder / str(os.getpid())).write_text("ended")
    return seconds


def test_an_interrupt_ends_what_runs_and_leaves_no_process(tmp_path, monkeypatch):
    monkeypatch.setenv("ENDS", str(tmp_path))
    start = time.monotonic()
    results = run_tasks(LocalProcesses(2), wait_for_ever, [600, 0])
    assert next(results) == (0, 0)
    deadline = time.monotonic() + 60
    while not any(path.read_text() for path in tmp_path.iterdir()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    # The traceback keeps the frames alive, so that nothing ends by being forgotten.
    with pytest.raises(KeyboardInterrupt) as caught:
        results.throw(KeyboardInterrupt())
    assert caught.tb is not None
    assert multiprocessing.active_children() == []
    # Not waited for: it is run again.
    assert time.monotonic() - start < 300
    assert [path.read_text() for path in tmp_path.iterdir()] == ["begun"]


def test_an_interrupt_keeps_what_is_done(ledger):
    done = []

    def interrupted(task):
        if done:
            raise KeyboardInterrupt
        done.append(task)
        return run_task(task)

    with pytest.raises(KeyboardInterrupt):
        run_all(TASKS, ledger, LocalProcesses(1), interrupted, progress=False)
    again = Ledger(ledger.path, PaperCell, EpisodeScore)
    assert set(again.rows) == {(done[0].cell, seed) for seed in SEEDS}


def test_only_what_is_missing_is_run(ledger):
    design = PaperDesign(seeds="2000:2002", estimators=("ekf",))
    tasks = missing_tasks(design, ledger, None)
    assert sum(len(task.seeds) for task in tasks) == 2 * len(design.cells())
    cell = design.base("ekf", SETTINGS[0])
    score = EpisodeScore(2000, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    ledger.append(cell, [score])
    left = {task.cell: task.seeds for task in missing_tasks(design, ledger, None)}
    assert left[cell] == (2001,)
    ledger.append(cell, [dataclasses.replace(score, traffic_seed=2001)])
    assert cell not in {task.cell for task in missing_tasks(design, ledger, None)}


def test_fewer_than_one_worker_is_refused():
    with pytest.raises(ValueError, match="workers must be an integer >= 1, got 0"):
        LocalProcesses(0)


def test_workers_end_with_their_parent():
    """No process outlives a program that is killed."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    parent = context.Process(target=_parent, args=(sender,))
    parent.start()
    sender.close()
    assert receiver.recv() == "ready"
    parent.kill()
    parent.join()
    # The grandchild holds the other end of the pipe; it closes when that process ends.
    assert receiver.poll(20)
    with pytest.raises(EOFError):
        receiver.recv()


def _parent(sender):
    context = multiprocessing.get_context("spawn")
    child = context.Process(target=_child, args=(sender,))
    child.start()
    child.join()


def _child(sender):
    follow_parent()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    sender.send("ready")
    multiprocessing.Event().wait(60)
