"""The search for the worst pair: it climbs, keeps to what is allowed, and finds a fault."""

import dataclasses

import numpy as np
import pytest

from agents.audit import search
from agents.audit.attack import attack
from agents.audit.search import Mutations, climb
from dptse_env.parts import privacy_report
from dptse_env.release import Paced
from tests.agents.elsewhere import elsewhere

from .small import HalfTheLimit, config, paced

SPANS = dataclasses.replace(paced("ekf", bandwidth=4), query_spans=(1, 2))


class RatioOfTwo(Paced):
    """Charges too little where two vehicles on one segment deviate in opposite directions."""

    def __init__(self, task, traffic):
        object.__setattr__(task.settings, "ratio", 2.0)
        super().__init__(task, traffic)


@pytest.fixture
def one_herd(monkeypatch):
    monkeypatch.setattr(search, "HERDS", 1)


def climbed(setting, record, rounds):
    """The largest distance of a search, over mu."""
    worlds, plan = climb(setting, record, rounds)
    runs = attack(setting, worlds, plan, 2, progress=False)
    return float(runs.distances.max()) / privacy_report(setting).mu


@pytest.mark.parametrize(
    "setting",
    [
        config(cap=12),
        config(unit="event", boundary_inputs="private"),
        paced("ekf", boundary_inputs="private"),
        paced("random_walk", adjacency="add_remove", clip=10.0),
        SPANS,
    ],
)
@pytest.mark.usefixtures("one_herd")
def test_it_climbs_to_mu_and_no_further(setting, record):
    assert 0.9 < climbed(setting, record, 6) <= 1.0 + 1e-9


@pytest.mark.usefixtures("one_herd")
def test_it_finds_a_fault_that_two_vehicles_on_one_segment_show(record):
    mutant = paced(HalfTheLimit, preset=RatioOfTwo, pace=0.4)
    start, end = climbed(mutant, record, 0), climbed(mutant, record, 15)
    assert end > max(start, 1.05)


@pytest.mark.parametrize(
    "setting", [SPANS, config(unit="event"), paced("ekf", adjacency="add_remove")]
)
def test_mutations_keep_to_the_bandwidth_and_to_what_is_protected(setting):
    generator, mutations = np.random.default_rng(0), Mutations(setting)
    pair = mutations.start(generator)
    for _ in range(50):
        other = mutations.mutated(pair, generator)
        assert (other.plan @ setting.queries.cost).max() <= setting.bandwidth
        assert (other.place[1] < 0).all() == (setting.privacy.adjacency == "add_remove")
        if setting.privacy.unit == "event":
            assert len({int(s) for trip in other.trips for s in trip.step}) == 1
        pair = other
    fixed = Mutations(setting, plan=pair.plan)
    for _ in range(20):
        assert fixed.mutated(pair, generator).plan is pair.plan


def test_a_search_depends_on_its_seed_alone(record, monkeypatch):
    monkeypatch.setattr(search, "CLIMBERS", 3)
    setting, found = paced("ekf"), []
    for options in ({}, {"executor": elsewhere}, {"seed": 1}):
        worlds, plan = climb(setting, record, 2, **options)
        found.append((worlds.trajectories[0].speed, plan))
    for one, other in zip(found[0], found[1], strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(found[0][1], found[2][1])
