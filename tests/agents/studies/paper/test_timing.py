import time

import pytest

from agents.experiments.runner import make_env
from agents.studies.paper.plan import PaperCell
from agents.studies.paper.timing import PAPER_SECONDS, Stopwatch, step_time
from dptse_env.config import resolve
from dptse_env.traffic import RecordLibrary

SHORT = "dptse_env:dptse/ShortHighway-v0"


class Sleeper:
    def nap(self, seconds):
        time.sleep(seconds)
        return "rested"

    def fail(self):
        raise RuntimeError


def test_a_stopwatch_adds_up_the_time_in_the_methods():
    sleeper = Sleeper()
    watch = Stopwatch(sleeper, ("nap", "fail"))
    assert sleeper.nap(0.02) == "rested"
    assert 0.02 <= watch.seconds < 1.0
    before = watch.seconds
    sleeper.nap(0.02)
    assert watch.seconds >= before + 0.02
    with pytest.raises(RuntimeError):
        sleeper.fail()


def test_a_step_is_timed_and_the_estimator_left_as_it_was(monkeypatch):
    RecordLibrary().ensure(resolve("short-highway", {}).corridor, (2000,))
    cell = PaperCell("random_walk", "w99-3lane", "paper", 1.0, 0.05, 2)
    env = make_env(SHORT, cell.keywords, (2000,), None)
    estimator = env.unwrapped.process.estimator
    update = type(estimator).update

    def slow(self, *args):
        time.sleep(0.001)
        update(self, *args)

    monkeypatch.setattr(type(estimator), "update", slow)
    timed = step_time(env, "paper", 2000)
    assert timed.traffic_seed == 2000
    assert 0.001 < timed.seconds < 0.1
    assert not {"predict", "update", "estimate"} & set(vars(estimator))


def test_the_paper_s_times():
    assert PAPER_SECONDS == {"ekf": 0.06, "ukf": 0.026, "enkf": 0.04, "mhe": 0.045}
