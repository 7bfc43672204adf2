import dataclasses
import multiprocessing
import signal
from concurrent.futures import ProcessPoolExecutor
from typing import ClassVar

import pytest

from agents.evaluation.episodes import EpisodeScore, run_episode
from agents.experiments import runner
from agents.experiments.ledger import Ledger
from agents.experiments.runner import Task, make_env, missing, run_all, run_task
from agents.studies.paper.plan import SCHEDULE, SETTINGS, Cell, Design
from dptse_env.config import resolve
from dptse_env.schedules import make_schedule
from dptse_env.traffic import RecordLibrary

SHORT = "dptse_env:dptse/ShortHighway-v0"
SEEDS = (2000, 2001)
EKF = Cell("ekf", "w99-3lane", "paper", 1.0, 0.05, 2)
WALK = dataclasses.replace(EKF, estimator="random_walk")
TASKS = [Task(SHORT, SCHEDULE, cell, SEEDS, None) for cell in (EKF, WALK)]


@pytest.fixture(autouse=True, scope="module")
def _records():
    RecordLibrary().ensure(resolve("short-highway", {}).corridor, SEEDS)


@pytest.fixture
def ledger(tmp_path):
    return Ledger(tmp_path / "episodes.csv", Cell, EpisodeScore)


def test_a_task_is_a_cell_on_its_seeds():
    scores = run_task(TASKS[0])
    assert [score.traffic_seed for score in scores] == list(SEEDS)
    assert scores[0].rmse_density != scores[1].rmse_density
    env = make_env(SHORT, EKF, SEEDS, None)
    schedule = make_schedule("paper", env)
    assert scores == [run_episode(env, schedule, traffic_seed=k, seed=k) for k in SEEDS]
    assert scores[1] != run_episode(env, schedule, traffic_seed=2001, seed=2000)
    assert run_task(dataclasses.replace(TASKS[0], seeds=(2001,))) == scores[1:]


def test_noise_alone_moves_what_differs_in_noise_alone():
    other = dataclasses.replace(TASKS[0], cell=dataclasses.replace(EKF, privacy="corrected"))
    for less, more in zip(run_task(TASKS[0]), run_task(other), strict=True):
        assert less.rmse_density < more.rmse_density


def test_the_open_loop_hears_nothing_that_its_canonical_cell_leaves_out():
    one = Cell("open_loop", "paper", "paper", 1.0, 0.05, 1)
    two = Cell("open_loop", "paper", "corrected", 0.1, 0.01, 3)
    first, second = (run_task(dataclasses.replace(TASKS[0], cell=cell)) for cell in (one, two))
    assert first == second


def test_workers_find_what_this_process_finds(ledger, tmp_path):
    run_all(TASKS, ledger, workers=2, progress=False)
    alone = Ledger(tmp_path / "alone.csv", Cell, EpisodeScore)
    run_all(TASKS, alone, workers=1, progress=False)
    assert ledger.rows == alone.rows
    assert set(ledger.rows) == {(cell, seed) for cell in (EKF, WALK) for seed in SEEDS}
    assert Ledger(ledger.path, Cell, EpisodeScore).rows == ledger.rows


def test_a_failure_in_a_worker_is_raised_and_leaves_no_process(ledger):
    bad = dataclasses.replace(TASKS[0], cell=dataclasses.replace(EKF, bandwidth=99))
    with pytest.raises(ValueError, match="bandwidth must be in"):
        run_all([bad, *TASKS], ledger, workers=2, progress=False)
    assert multiprocessing.active_children() == []


class Pool(ProcessPoolExecutor):
    """A pool that can be asked how its processes ended."""

    processes: ClassVar[list] = []

    def shutdown(self, *args, **keywords):
        self.processes[:] = (self._processes or {}).values()
        super().shutdown(*args, **keywords)


def test_an_interrupt_keeps_what_is_done_and_leaves_no_process(ledger, monkeypatch):
    append, done = ledger.append, []

    def interrupted(cell, scores):
        append(cell, scores)
        done.append(cell)
        raise KeyboardInterrupt

    monkeypatch.setattr(ledger, "append", interrupted)
    monkeypatch.setattr(runner, "ProcessPoolExecutor", Pool)
    # The traceback keeps the frames alive, so that nothing ends by being forgotten.
    with pytest.raises(KeyboardInterrupt) as caught:
        run_all(TASKS, ledger, workers=2, progress=False)
    assert caught.tb is not None
    assert multiprocessing.active_children() == []
    # Not waited for: what they were at is run again.
    assert {process.exitcode for process in Pool.processes} == {-signal.SIGTERM}
    assert set(Ledger(ledger.path, Cell, EpisodeScore).rows) == {(done[0], seed) for seed in SEEDS}


def test_only_what_is_missing_is_run(ledger):
    design = Design(seeds=SEEDS, estimators=("ekf",))
    assert sum(len(task.seeds) for task in missing(design, ledger, None)) == 2 * len(design.cells())
    cell = design.base("ekf", SETTINGS[0])
    score = EpisodeScore(2000, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    ledger.append(cell, [score])
    left = {task.cell: task.seeds for task in missing(design, ledger, None)}
    assert left[cell] == (2001,)
    ledger.append(cell, [dataclasses.replace(score, traffic_seed=2001)])
    assert cell not in {task.cell for task in missing(design, ledger, None)}


def test_fewer_than_one_worker_is_refused(ledger):
    with pytest.raises(ValueError, match="workers must be an integer >= 1, got 0"):
        run_all(TASKS, ledger, workers=0, progress=False)


def test_workers_end_with_their_parent():
    """Whoever kills this program leaves nobody behind."""
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
    runner._begin_worker()
    sender.send("ready")
    multiprocessing.Event().wait(60)
