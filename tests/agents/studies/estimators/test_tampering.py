import numpy as np
import pytest

from agents.environments import make_vector
from agents.evaluation.episodes import run_episodes
from agents.studies.estimators import tampering
from agents.studies.estimators.tampering import tamper
from dptse_env.schedules import make_schedule

from .made_up import SHORT


class Noting:
    """An estimator that notes what it is given."""

    def __init__(self, process):
        self._estimator = process.estimator
        self.inputs, self.updates = [], []
        process.estimator = self

    def __getattr__(self, name):
        return getattr(self._estimator, name)

    def predict(self, episodes, inputs):
        self.inputs.append(np.array(inputs))
        self._estimator.predict(episodes, inputs)

    def update(self, *arguments):
        self.updates.append([np.array(each) for each in arguments])
        self._estimator.update(*arguments)


def play(kind=None):
    keywords = {"privacy": "paced", "estimator": "random_walk", "traffic_seeds": [0, 1]}
    env = make_vector(SHORT, 2, {**keywords, "threads": 1})
    noting = Noting(env.process)
    if kind is not None:
        tamper(env.process, kind)
    policy = make_schedule("round-robin", env)
    run_episodes(env, policy, traffic_seeds=(0, 1), seeds=(0, 1))
    return noting, env.process


def test_episodes_get_the_values_of_others():
    noting, _ = play(tampering.OTHER_RELEASES)
    plain, _ = play()
    # The first releases do not depend on estimates, which differ later.
    np.testing.assert_array_equal(noting.updates[0][2][::-1], plain.updates[0][2])


def test_demand_is_held():
    noting, process = play(tampering.CONSTANT_DEMAND)
    entries = process.model.layout.entry_inputs
    first = noting.inputs[0][:, entries]
    assert all((each[:, entries] == first).all() for each in noting.inputs)
    plain, _ = play()
    assert not all((each[:, entries] == first).all() for each in plain.inputs)


def test_fixed_sensors_fail_for_their_minute(monkeypatch):
    monkeypatch.setattr(tampering, "FIRST", 30)
    monkeypatch.setattr(tampering, "LAST", 50)
    noting, process = play(tampering.FAILING)
    sensors = list(process.config.corridor.fixed_sensors)
    seen = np.array([update[1][:, sensors].any() for update in noting.updates])
    np.testing.assert_array_equal(np.flatnonzero(~seen), np.arange(30, 50) - 1)


def test_unknown_tampering_is_named():
    with pytest.raises(ValueError, match=r"tampering must be one of failing, .* got 'magic'"):
        tamper(None, "magic")
