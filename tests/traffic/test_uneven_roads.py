"""Roads whose segments differ, driven in SUMO."""

import dataclasses
import itertools
import re

import numpy as np
import pytest

from dptse_env.traffic import PAPER_HIGHWAY, Incident, simulate
from dptse_env.traffic.sumo_network import edge_ids, network_xml
from tests.model.roads import UNEVEN

ROAD = dataclasses.replace(
    UNEVEN, duration=240, incident=Incident(5, ((60.0, 120.0, 10.0), (120.0, 140.0, 40.0)))
)


@pytest.fixture(scope="module")
def uneven():
    return simulate(ROAD, 0)


def successors(corridor):
    """Columns into which a vehicle may pass from each column."""
    n, s = corridor.n_mainline, corridor.n_segments
    following = {i: {i + 1} for i in range(n - 1)} | {n - 1: {s + 1}, s: {0}}
    boundary = s + 2
    for face, segments in zip(corridor.on_ramps, corridor.on_ramp_segments, strict=True):
        chain = [boundary, *segments, face]
        following |= {a: {b} for a, b in itertools.pairwise(chain)}
        boundary += 1
    for face, segments in zip(corridor.off_ramps, corridor.off_ramp_segments, strict=True):
        chain = [*segments, boundary]
        following |= {a: {b} for a, b in itertools.pairwise(chain)}
        following[face - 1].add(segments[0])
        boundary += 1
    return following


def test_vehicles_pass_from_segment_to_segment_along_the_road(uneven):
    following = successors(ROAD)
    passed = set()
    for vehicle in range(uneven.n_vehicles):
        mine = uneven.vehicle == vehicle
        places, steps = uneven.segment[mine].tolist(), uneven.step[mine]
        assert np.all(np.diff(steps) == 1), "a vehicle vanished for a while"
        for a, b in itertools.pairwise(places):
            if a != b:
                # A second may take a fast vehicle over the whole of a short segment.
                reached, two = following[a], set()
                for between in reached:
                    two |= following.get(between, set())
                assert b in reached | two, (a, b)
                passed.add((a, b))
    for a, reached in following.items():
        assert any((a, b) in passed for b in reached), f"nobody ever left column {a}"


def test_the_network_has_the_lengths_lanes_and_limits_of_the_corridor():
    text = network_xml(ROAD)
    lengths = ROAD.with_boundaries(ROAD.segment_lengths)
    lanes = ROAD.with_boundaries(ROAD.segment_lanes)
    limits = ROAD.with_boundaries(ROAD.speed_limits)
    for edge, length, count, limit in zip(edge_ids(ROAD), lengths, lanes, limits, strict=True):
        found = re.findall(
            rf'<lane id="{edge}_\d+" index="\d+" .*?speed="([\d.]+)" length="([\d.]+)"', text
        )
        assert len(found) == count, edge
        assert {float(speed) for speed, _ in found} == {round(limit / 3.6, 2)}
        assert {float(each) for _, each in found} == {round(1000.0 * length, 2)}


def test_the_limit_after_an_incident_is_that_of_its_segment(uneven):
    slow, after = slice(80, 120), slice(180, 240)
    speeds = uneven.speed_sums[:, 5] / np.maximum(uneven.counts[:, 5], 1)
    seen = uneven.counts[:, 5] > 0
    assert speeds[slow][seen[slow]].mean() < 20.0
    assert 40.0 < speeds[after][seen[after]].mean() <= 1.2 * 80.0


def test_equal_values_are_the_same_road_as_one_value():
    same = dataclasses.replace(
        PAPER_HIGHWAY,
        lanes=(3,) * 15,
        segment_length=(0.1,) * 15,
        speed_limit=(102.0,) * 15,
        ramp_lanes=(1,) * 4,
        ramp_segments=(1,) * 4,
    )
    assert same == PAPER_HIGHWAY
    assert same.digest == PAPER_HIGHWAY.digest
