"""No policy tells two worlds apart by more than mu, given the same past releases.

The property holds surely, so it is tested without noise: the true answers of two worlds that differ
in one vehicle are never further apart than mu, in units of the noise. Each way of getting it wrong
is kept as a mutant that breaks the bound.
"""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.privacy import mu_of
from dptse_env.release import CappedSettings, PrivacySettings

from .adjacent import adjacent_trips
from .worlds import AWAY, Mutant, Worlds, corridor, record, squared_distance

T, COLUMNS, SEGMENTS = 10, 12, 8
LIMIT = corridor(T).speed_limit
SLACK = 1.0 + 1e-9


@st.composite
def policies(draw, places, other_places):
    """A policy that asks at random, one that chases what was released, or one that knows."""
    kind = draw(st.sampled_from(["random", "hunter", "oracle"]))
    if kind == "random":
        masks = draw(arrays(bool, (T, COLUMNS)))
        return lambda past: masks[len(past)]
    if kind == "hunter":
        bandwidth, ahead = draw(st.integers(1, 3)), draw(st.integers(0, 1))
        return lambda past: hunt(past, bandwidth, ahead)

    def follow(past):
        asked = np.zeros(COLUMNS, dtype=bool)
        for trip in (places[0], other_places[0]):
            if trip[len(past) + 1] != AWAY:
                asked[trip[len(past) + 1]] = True
        return asked

    return follow


def hunt(past, bandwidth, ahead):
    """Ask where the latest releases saw most, or one segment further on."""
    seen = np.zeros(COLUMNS)
    for observed, released in past:
        seen = np.where(
            observed, np.abs(released[:, 0]) + np.abs(released[:, 1]) / LIMIT, 0.9 * seen
        )
    asked = np.zeros(COLUMNS, dtype=bool)
    asked[(np.argsort(-seen, kind="stable")[:bandwidth] + ahead) % COLUMNS] = True
    return asked


@st.composite
def wishes(draw):
    return CappedSettings(
        epsilon=draw(st.sampled_from([0.5, 5.0])),
        unit=draw(st.sampled_from(["trip", "horizon", "event"])),
        cap=draw(st.sampled_from([1, 3, 64])),
        adjacency=draw(st.sampled_from(["replace", "add_remove"])),
        share=draw(st.sampled_from([0.1, 0.5, 0.8])),
    )


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_no_policy_exceeds_mu(data):
    asked = data.draw(wishes())
    places, speeds, other_places, other_speeds = data.draw(adjacent_trips(asked, 4, T, 3, LIMIT))
    policy = data.draw(policies(places, other_places))
    always = data.draw(st.sampled_from([(), (1,), (0, 2)]))
    worlds = Worlds(record(places, speeds, COLUMNS), record(other_places, other_speeds, COLUMNS))
    release = worlds.release(asked)
    found = squared_distance(release, policy, T, always)
    mu = release.report().mu
    assert mu <= mu_of(asked.epsilon, asked.delta) * SLACK
    assert found <= mu**2 * SLACK
    # As many steps as were released: the account that a running episode shows.
    short = T // 2
    spent, _ = release.spent(np.array([0]), np.array([short]))
    found = squared_distance(release, policy, short, always)
    assert found <= spent[0] ** 2 * SLACK


def lone(place, speed, steps=T, present=True):
    """A record of one vehicle that stays; step 0 is empty."""
    places = np.full((1, steps + 1), place if present else AWAY)
    places[:, 0] = AWAY
    return record(places, np.full((1, steps + 1), speed), COLUMNS)


def ask_all(past):
    return np.ones(COLUMNS, dtype=bool)


def bounds(asked, steps=T):
    """a and f of the proof: a vehicle's squared terms in units of the noise."""
    length = corridor(steps).segment_length
    density, flow = Worlds(lone(1, 0.0, steps)).release(asked).sigma
    return 1.0 / (length * density) ** 2, (0.5 * LIMIT / (length * flow)) ** 2


@settings(deadline=None)
@given(share=st.floats(0.05, 0.95), cap=st.integers(1, T))
@example(share=0.5, cap=4)
def test_the_extremes_of_the_proof_are_met_and_no_more(share, cap):
    asked = CappedSettings(cap=cap, share=share)
    mu = mu_of(asked.epsilon, asked.delta)
    a, f = bounds(asked)
    same = Worlds(lone(2, 0.0), lone(2, LIMIT)).release(asked)
    apart = Worlds(lone(1, 0.0), lone(2, LIMIT)).release(asked)
    found = [squared_distance(release, ask_all, T) for release in (same, apart)]
    assert found == pytest.approx([4.0 * f * cap, 2.0 * (a + f) * cap], rel=1e-12)
    # Neither is slack: the larger of the two is the whole budget.
    assert max(found) == pytest.approx(mu**2, rel=1e-9)
    if share == 0.5:
        assert found == pytest.approx([mu**2, mu**2], rel=1e-9)


@pytest.mark.parametrize(("unit", "counted"), [("trip", 3), ("horizon", T), ("event", 1)])
def test_one_vehicle_more_costs_what_its_unit_says(unit, counted):
    asked = CappedSettings(unit=unit, cap=3, adjacency="add_remove", share=0.3)
    a, f = bounds(asked)
    if unit == "event":
        places = np.full((1, T + 1), 2)
        without = places.copy()
        without[0, 4] = AWAY
        speeds = np.full((1, T + 1), LIMIT)
        worlds = Worlds(record(places, speeds, COLUMNS), record(without, speeds, COLUMNS))
    else:
        worlds = Worlds(lone(2, LIMIT), lone(2, LIMIT, present=False))
    found = squared_distance(worlds.release(asked), ask_all, T)
    assert found == pytest.approx(counted * (a + f), rel=1e-12)
    assert found == pytest.approx(mu_of(asked.epsilon, asked.delta) ** 2, rel=1e-9)


# --- seeded mutations: each must break the bound --------------------------------------------------


def test_the_sensitivity_of_the_paper_is_exceeded():
    """By a vehicle that stands in view for 300 s, in density alone."""
    steps = 300
    release = Worlds(lone(1, 10.0, steps), lone(2, 10.0, steps)).release(
        PrivacySettings("corrected")
    )
    density = np.array([release.sigma[0], np.inf])
    found = squared_distance(release, ask_all, steps, std=density)
    claimed = release.report().releases[0]
    # Two queries, two fixed sensors and four boundary segments, each passed once for the average.
    dwell = release.setup.corridor.average_dwell
    assert claimed.sensitivity == pytest.approx(10.0 * math.sqrt(2 * 8 * dwell))
    assert found == pytest.approx(claimed.mu**2 * 2 * steps / (2 * 8 * dwell), rel=1e-12)
    assert found > 3.0 * claimed.mu**2


def test_mean_speeds_exceed_mu():
    means = CappedSettings(cap=4, speed_release="mean")
    flows = CappedSettings(cap=4)
    worlds = Worlds(lone(2, 0.0), lone(2, LIMIT))
    mu = mu_of(means.epsilon, means.delta)
    assert squared_distance(worlds.release(flows), ask_all, T) <= mu**2 * SLACK
    assert squared_distance(worlds.release(means), ask_all, T) > 100.0 * mu**2


def wanderer(speed):
    """A vehicle that is on another segment every other second."""
    places = np.repeat(np.arange(T // 2 + 1), 2)[None, : T + 1]
    return record(places, np.full((1, T + 1), speed), COLUMNS)


def queue(first):
    """Vehicle 0, if there, stands on segment 2 for the first half; vehicle 1 for the second."""
    places = np.full((2, T + 1), AWAY)
    half = T // 2
    if first:
        places[0, 1 : half + 1] = 2
    places[1, half + 1 :] = 2
    return record(places, np.full((2, T + 1), LIMIT), COLUMNS)


CAP = T // 2
MUTANTS = {
    "a cap for each segment": (
        (wanderer(0.0), lone(2, 0.0, present=False)),
        lambda vehicle, segment: (vehicle, segment),
        lambda segment: True,
    ),
    "fixed sensors that are not charged": (
        (lone(2, 0.0), lone(2, 0.0, present=False)),
        lambda vehicle, segment: (vehicle,),
        lambda segment: segment != 2,
    ),
    "a cap that vehicles share": (
        (queue(first=True), queue(first=False)),
        lambda vehicle, segment: (segment,),
        lambda segment: True,
    ),
}


@pytest.mark.parametrize(("records", "key", "charges"), MUTANTS.values(), ids=MUTANTS)
def test_other_ways_to_count_exceed_mu(records, key, charges):
    asked = CappedSettings(cap=CAP, adjacency="add_remove")
    mu, worlds = mu_of(asked.epsilon, asked.delta), Worlds(*records)
    sound = squared_distance(worlds.release(asked), ask_all, T, always=(2,))
    assert math.isclose(sound, mu**2, rel_tol=1e-9)
    mutant = worlds.release(asked, Mutant(records, CAP, key, charges))
    assert squared_distance(mutant, ask_all, T, always=(2,)) > 1.9 * mu**2


def test_a_mutant_that_counts_as_it_should_is_none():
    asked = CappedSettings(cap=CAP)
    records = wanderer(30.0), wanderer(90.0)
    worlds = Worlds(*records)
    same = worlds.release(asked, Mutant(records, CAP, lambda vehicle, segment: (vehicle,)))
    assert squared_distance(same, ask_all, T) == pytest.approx(
        squared_distance(worlds.release(asked), ask_all, T), rel=1e-12
    )
