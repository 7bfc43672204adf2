import time

import pytest

from agents.policies import find_policy
from agents.suite import guard
from agents.suite.card import DONE, FAILED
from agents.suite.running import SuiteTask, run_cell

from .small import SMALL

HERE = "tests.agents.suite.small"
PLAIN, WIDE, _ = SMALL.cells


def result_of(source, cell=PLAIN):
    return run_cell(SuiteTask(find_policy(source), cell, None))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("too_few", "no valid action: actions must be 3, one for each episode, got shape (2, 6)"),
        ("not_a_number", "no valid action: action must hold 0 and 1 only"),
        ("text", "no valid action: actions must be 3"),
        ("nothing", "no valid action: actions must be 3"),
        ("Absent", "raised ValueError: schedule 'tests.agents.suite.small:Absent'"),
        ("Raising", "raised KeyError: 'no third segment'"),
    ],
)
def test_a_policy_that_fails_has_a_reason(name, reason):
    result = result_of(f"{HERE}:{name}", WIDE)
    assert result.status == FAILED
    assert result.reason.startswith(reason)
    assert result.error == ()


def test_a_failure_in_one_cell_is_none_in_another():
    result = result_of(f"{HERE}:Raising")
    assert (result.status, result.reason) == (DONE, "")
    assert len(result.error) == 3


def test_a_policy_that_hangs_is_interrupted(monkeypatch):
    monkeypatch.setattr(guard, "LONGEST_STEP", 0.2)
    started = time.perf_counter()
    result = result_of(f"{HERE}:Slow")
    assert result.reason == "took longer than 0.6 s for a step of all episodes"
    assert time.perf_counter() - started < 50.0


def test_a_slow_first_decision_may_compile(monkeypatch):
    class Compiling:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            time.sleep(0.05 if state is None else 0.0)
            return env.action_space.sample(), 1

    from agents.experiments.runner import make_batch

    env = make_batch(PLAIN.env, PLAIN.keywords, PLAIN.traffic_seeds)
    observation, _ = env.reset(seed=0)
    monkeypatch.setattr(guard, "LONGEST_STEP", 0.01)
    guarded = guard.Guarded(Compiling(), env)
    _, state = guarded.predict(observation)
    guarded.predict(observation, state)
    assert guarded.n_decisions == 3
    with pytest.raises(guard.PolicyError, match=r"took longer than 0\.03 s"):
        guarded.predict(observation)


def test_an_interrupt_stays_an_interrupt():
    with pytest.raises(KeyboardInterrupt), guard.foreign_code():
        raise KeyboardInterrupt
