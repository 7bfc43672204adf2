"""Scenarios: arrivals, routes, classes and incidents of a traffic seed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.traffic import (
    MAINLINE,
    PAPER_HIGHWAY,
    Demand,
    Incident,
    IncidentDistribution,
    VehicleClass,
    draw_scenario,
    randomised,
)

SEEDS = range(200)
CLASSES = (VehicleClass("car", 0.7), VehicleClass("truck", 0.3, length=12.0))


def test_the_same_seed_draws_the_same_scenario_and_another_seed_another():
    first, again, other = (draw_scenario(PAPER_HIGHWAY, seed) for seed in (3, 3, 4))
    for field in ("departures", "origins", "exits"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert first.sumo_seed == again.sumo_seed != other.sumo_seed
    assert not np.array_equal(first.departures, other.departures)


@given(seed=st.integers(0, 2**63))
def test_departures_are_ordered_and_every_exit_lies_ahead_of_its_origin(seed):
    scenario = draw_scenario(PAPER_HIGHWAY, seed)
    assert np.all(np.diff(scenario.departures) >= 0)
    assert scenario.departures.min() >= 0
    assert scenario.departures.max() <= PAPER_HIGHWAY.conditions.duration
    second_ramp = scenario.origins == 1  # joins at face 9, past the first off-ramp at face 6
    assert not np.any(scenario.exits[second_ramp] == 0)


def test_arrivals_are_poisson_with_the_declared_rates():
    counts = []
    for scenario in (draw_scenario(PAPER_HIGHWAY, seed) for seed in SEEDS):
        times = [scenario.departures[scenario.origins == origin] for origin in (MAINLINE, 0, 1)]
        early, late = np.histogram(times[0], [0, 200, 400])[0]
        counts.append([early, late, len(times[1]), len(times[2])])
    expected = np.array([2050 * 200, 6050 * 200, 320 * 700, 300 * 700]) / 3600
    # Mean and variance of a Poisson count agree; the bounds are four standard errors.
    error = np.abs(np.mean(counts, axis=0) - expected)
    assert np.all(error < 4 * np.sqrt(expected / len(SEEDS)))
    ratio = np.var(counts, axis=0, ddof=1) / expected
    assert np.all(np.abs(ratio - 1) < 4 * np.sqrt(2 / len(SEEDS)))


def test_the_streams_are_independent_of_one_another():
    corridor = randomised(PAPER_HIGHWAY)
    fixed = corridor.replaced(incident=Incident(2, ((10, 20, 10),)))
    random_scenario, fixed_scenario = draw_scenario(corridor, 5), draw_scenario(fixed, 5)
    assert random_scenario.incidents != fixed_scenario.incidents
    assert random_scenario.demand == fixed_scenario.demand
    np.testing.assert_array_equal(random_scenario.departures, fixed_scenario.departures)


def test_rates_of_a_ramp_and_shares_of_an_exit_follow_their_steps():
    demand = Demand(
        mainline=((0.0, 20_000.0),),
        on_ramps=(((0.0, 0.0), (300.0, 20_000.0)), 0.0),
        exit_shares=(((0.0, 0.9), (350.0, 0.1)), ((0.0, 0.5),)),
    )
    corridor = PAPER_HIGHWAY.replaced(demand=demand, incident=None)
    scenario = draw_scenario(corridor, 0)
    ramp = scenario.departures[scenario.origins == 0]
    assert ramp.min() > 300.0
    assert len(ramp) == pytest.approx(400 * 20_000 / 3600, rel=0.1)
    through = scenario.origins == MAINLINE
    early = scenario.departures < 350.0
    for when, share in ((early, 0.9), (~early, 0.1)):
        taken = scenario.exits[through & when] == 0
        assert taken.mean() == pytest.approx(share, abs=0.05)


def test_vehicles_have_classes_by_their_shares_and_else_move_alike():
    corridor = PAPER_HIGHWAY.replaced(vehicle_classes=CLASSES)
    scenarios = [draw_scenario(corridor, seed) for seed in range(20)]
    classes = np.concatenate([each.classes for each in scenarios])
    assert classes.mean() == pytest.approx(0.3, abs=0.02)
    assert set(classes.tolist()) == {0, 1}
    plain = draw_scenario(PAPER_HIGHWAY, 3)
    assert not plain.classes.any()
    for name in ("departures", "origins", "exits"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(scenarios[3], name))
    assert plain.sumo_seed == scenarios[3].sumo_seed


def test_incidents_are_drawn_one_by_one():
    drawn = IncidentDistribution(tuple(range(5)))
    fixed = Incident(7, ((10, 20, 10),))
    both = PAPER_HIGHWAY.replaced(incident=(drawn, fixed, drawn))
    alone = PAPER_HIGHWAY.replaced(incident=drawn)
    first, second, third = draw_scenario(both, 3).incidents
    assert first == draw_scenario(alone, 3).incidents[0]
    assert second == fixed
    assert third != first
    assert both.replaced(incident=(drawn,)) == alone
    assert both.replaced(incident=()).conditions.incident is None
