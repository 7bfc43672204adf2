"""The audit of a vehicle that answers queries and passes fixed sensors."""

import dataclasses

import numpy as np
import pytest

from agents.audit.planner import Planner
from agents.audit.worlds import AuditedPenetration, Trajectory, Worlds, audited
from dptse_env.config import resolve
from dptse_env.parts import privacy_report
from dptse_env.release import Capped
from dptse_env.traffic import Penetration, RecordLibrary

from . import small

HORIZON, SENSOR = 60, 3


def config(preset="capped", **privacy):
    given = {"preset": preset, "epsilon": 2.0, "adjacency": "add_remove", **privacy}
    if preset == "capped":
        given = {"cap": 20, **given}
    return resolve(
        "short-highway",
        {
            "penetration": 0.3,
            "horizon": HORIZON,
            "privacy": given,
            "corridor": {"fixed_sensors": [SENSOR, 7]},
        },
    )


@pytest.fixture(scope="module")
def record():
    return RecordLibrary().get(config().corridor, 0)


def standing(record):
    there = Trajectory.constant(np.arange(1, HORIZON + 1), SENSOR, 0.0)
    return Worlds.adjacent(record, (there, Trajectory.absent()))


def reached(setting, worlds):
    plan = np.zeros((HORIZON, 6), dtype=bool)
    plan[:, SENSOR] = True
    return small.reached(setting, worlds, plan)


def test_a_vehicle_that_both_see_is_as_visible_as_the_account_says(record):
    assert reached(config(), standing(record)) == pytest.approx(1.0, rel=1e-9)


class Generous(Capped):
    """Spends the whole budget in each group."""

    def _noise_std(self, group):
        return tuple(std * np.sqrt(self.task.shares[group]) for std in super()._noise_std(group))


def test_groups_that_forget_their_shares_are_found_out(record):
    setting = config(Generous, cap=20)
    assert privacy_report(setting).void_reasons == ("releases_not_composed",)
    assert reached(setting, standing(record)) == pytest.approx(1.0)
    assert privacy_report(setting).mu == pytest.approx(np.sqrt(2.0) * privacy_report(config()).mu)


@pytest.mark.parametrize("adjacency", ["add_remove", "replace"])
@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_the_worst_case_of_the_planner_reaches_most_of_mu(preset, adjacency, record):
    setting = config(preset, adjacency=adjacency)
    worlds = Planner(setting).choose(record, "worst-case")
    assert 0.85 < small.reached(setting, worlds) <= 1.0 + 1e-9


def test_both_worlds_have_the_same_connected_vehicles_and_the_target_is_one(record):
    worlds = standing(record)
    setting = audited(config(), worlds)
    penetration = setting.penetration
    assert isinstance(penetration, AuditedPenetration)
    records = [worlds.get(setting.corridor, seed) for seed in (0, 1)]
    zero, one = (penetration.connected(seed, each) for seed, each in enumerate(records))
    shared = slice(min(zero.size, one.size))
    np.testing.assert_array_equal(zero[shared], one[shared])
    assert zero[record.n_vehicles]
    np.testing.assert_array_equal(zero[:-1], Penetration(0.3).connected(0, record))
    whole = dataclasses.replace(config(), penetration=Penetration())
    assert audited(whole, worlds).penetration == Penetration()
