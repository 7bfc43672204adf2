"""Readings of loops: those of SUMO's own, and of vehicles that are hard to follow."""

from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from dptse_env.traffic import (
    CORRIDORS,
    SHORT_HIGHWAY,
    Incident,
    Loops,
    Record,
    Stations,
    draw_scenario,
    readings,
    sumo,
)
from dptse_env.traffic.loops import borders_of
from tests.helpers import AWAY, SHORT_COLUMNS, UNEVEN, fast_and_slow, record
from tests.traffic.test_sumo import CLASSES

INTERVAL = 20


def with_all_loops(corridor, **fields):
    """A road with a station at every border of the mainline and on every ramp."""
    road = corridor.replaced(**fields)
    geometry = road.geometry
    ramps = sorted([*geometry.on_ramps, *geometry.off_ramps])
    positions = borders_of(geometry).tolist()
    return road.replaced(loops={"positions": positions, "ramps": ramps, "interval": INTERVAL})


JAMMED = with_all_loops(
    UNEVEN,
    duration=310,
    incident=Incident(5, ((60.0, 160.0, 10.0), (160.0, 180.0, 40.0))),
    vehicle_classes=CLASSES,
)
# Vehicles pass several segments in a second.
FAST = with_all_loops(
    UNEVEN, duration=130, segment_length=0.041, speed_limit=300.0, ramp_length=0.05, lanes=3
)


def read(road, made):
    return readings(made, Stations.of(road.loops, road.geometry), road.loops)


def detected(corridor, monkeypatch, seed=0):
    """A record, and what SUMO's loops have seen: sums of vehicles (K, F), and each passage.

    Passages are lists of (interval, speed) by (station, vehicle).
    """
    n, edges = corridor.geometry.n_mainline, sumo.edge_ids(corridor.geometry)
    places = [(edges[f] if f < n else "downstream", 0.0001) for f in range(n + 1)]
    places += [(edges[ramp[-1]], -0.0001) for ramp in corridor.geometry.on_ramp_segments]
    places += [(edges[ramp[0]], 0.0001) for ramp in corridor.geometry.off_ramp_segments]
    lanes = corridor.geometry.segment_lanes
    loops = [
        f'<{kind} id="{station}_{lane}" lane="{edge}_{lane}" pos="{at}" file="{file}" {period}/>'
        for kind, file, period in (
            ("e1Detector", "sums.xml", f'period="{INTERVAL}"'),
            ("instantInductionLoop", "passages.xml", ""),
        )
        for station, (edge, at) in enumerate(places)
        for lane in range(lanes[edges.index(edge) if edge != "downstream" else n - 1])
    ]
    usual = sumo._command

    def command(folder, *rest):
        (folder / "loops.xml").write_text(f"<additional>{''.join(loops)}</additional>")
        return [*usual(folder, *rest), "-a", "loops.xml"]

    monkeypatch.setattr(sumo, "_command", command)
    with sumo.running(corridor, draw_scenario(corridor, seed)) as libsumo:
        record = sumo._observe(libsumo, corridor, draw_scenario(corridor, seed))
        libsumo.close()
        sums, passages = (ElementTree.parse(f"{name}.xml").getroot() for name in
                          ("sums", "passages"))  # fmt: skip
    K, seen = corridor.conditions.duration // INTERVAL, {}
    entered = np.zeros((K, len(places)))
    for line in sums:
        if float(line.get("end")) <= K * INTERVAL:
            interval = int(float(line.get("begin"))) // INTERVAL
            entered[interval, int(line.get("id").split("_")[0])] += int(line.get("nVehEntered"))
    for line in passages:
        if line.get("state") == "enter":
            step = np.ceil(2.0 * float(line.get("time"))) / 2.0  # of SUMO, that it happened in
            key = int(line.get("id").split("_")[0]), int(line.get("vehID"))
            what = int(step // INTERVAL), 3.6 * float(line.get("speed"))
            seen.setdefault(key, []).append(what)
    return record, entered, seen


@pytest.mark.parametrize(
    "road",
    fast_and_slow([JAMMED, FAST, *map(with_all_loops, CORRIDORS.values())], [JAMMED, FAST]),
    ids=lambda road: f"{road.name}-{road.geometry.segment_length}",
)
def test_counts_and_speeds_are_those_of_loops_in_sumo(road, monkeypatch):
    record, entered, seen = detected(road, monkeypatch)
    found = read(road, record)
    # SUMO counts a vehicle once more where it changes its lane on a loop.
    again, speeds = np.zeros_like(entered), np.zeros_like(entered)
    for (station, _), ((interval, speed), *others) in seen.items():
        for late, _ in others:
            again[late, station] += late < len(again)
        if interval < len(speeds):
            speeds[interval, station] += speed
    np.testing.assert_array_equal(found[..., 0], entered - again)
    assert again.sum() < 0.015 * entered.sum()
    passed = found[..., 0] > 0
    assert passed.sum() > 0.5 * passed.size
    error = found[passed, 1] - speeds[passed] / found[passed, 0]
    # A record has the speeds at both seconds, and the vehicle may brake or speed up in between.
    assert np.sqrt(np.mean(error**2)) < 1.6


N, ON_RAMP, OFF_RAMP, UPSTREAM, DOWNSTREAM, BEFORE, AFTER = 6, 6, 7, 8, 9, 10, 11
"""Mainline segments and cells of the short highway, whose ramps are at faces 2 and 4."""
STATIONS = (0, 1, 2, 3, 4, 5, N, "on", "off")
SHORT_ROAD = with_all_loops(SHORT_HIGHWAY, duration=40, incident=None)


def each(seconds, made):
    """Readings of all stations of the short highway in shorter intervals than loops have."""
    stations = Stations.of(SHORT_ROAD.loops, SHORT_ROAD.geometry)
    return readings(made, stations, SimpleNamespace(interval=seconds, least_count=0))


def driven(places, speeds=72.0):
    """A record of a vehicle on the short highway, from its cell by second."""
    seconds, cells = zip(*places.items(), strict=True)
    return Record(
        step=seconds, vehicle=np.zeros(len(cells)), segment=cells,
        speed=np.broadcast_to(speeds, len(cells)), n_steps=41, n_columns=SHORT_COLUMNS,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("places", "passed"),
    [
        # over some borders, one after another and within a second
        ({5: UPSTREAM, 6: 0, 7: 0, 8: 1}, {(6, 0), (8, 1)}),
        ({5: UPSTREAM, 6: 3}, {(6, 0), (6, 1), (6, 2), (6, 3)}),
        ({39: 4, 40: DOWNSTREAM}, {(40, 5), (40, N)}),
        # from a ramp and to one
        ({5: BEFORE, 6: ON_RAMP, 7: 2, 8: 3}, {(7, 2), (7, "on"), (8, 3)}),
        ({5: BEFORE, 6: OFF_RAMP, 7: AFTER}, {(6, "on"), (6, 2), (6, 3), (6, "off")}),
        ({5: 2, 6: 3, 7: OFF_RAMP}, {(6, 3), (7, "off")}),
        # from second 0 on, and to the last one: nobody has seen it come or go
        ({0: 0, 1: 1}, {(1, 1)}),
        ({39: N - 1, 40: N - 1}, set()),
        # comes to sight, and is lost, at the ends of the road and within it
        ({5: 0, 6: 0, 40: 0}, {(5, 0), (40, 0)}),
        ({5: 4, 6: N - 1}, {(6, 5), (7, N)}),
        ({5: 2, 6: 3}, {(6, 3)}),
        # out of sight for a while, and for so long that it is another visit
        ({5: 1, 15: 4}, {(15, 2), (15, 3), (15, 4)}),
        ({5: 1, 16: 4}, set()),
        ({5: DOWNSTREAM, 30: UPSTREAM, 31: 0}, {(31, 0)}),
        # to and fro, as by errors of positions
        ({5: 2, 6: 3, 7: 2, 8: 3, 9: 2}, {(6, 3)}),
        ({5: OFF_RAMP, 6: 3, 7: 4}, {(7, 4)}),
    ],
)
def test_who_passes_is_counted_once_in_the_second_that_ends_beyond(places, passed):
    found = each(1, driven(places))
    intervals, stations = np.nonzero(found[..., 0])
    seconds = (intervals + 1).tolist()
    assert set(zip(seconds, (STATIONS[f] for f in stations), strict=True)) == passed
    assert found[..., 0].max() <= 1


def test_speeds_are_means_of_both_seconds_and_over_vehicles():
    found = each(1, driven({5: UPSTREAM, 6: 0, 8: 0}, (50.0, 60.0, 99.0)))
    assert found[5, 0].tolist() == [1.0, 55.0]
    assert np.isnan(found[4, 0, 1])
    two = record([[8, 0, 0], [AWAY, 8, 0]], [[50.0, 60.0, 0.0], [0.0, 20.0, 30.0]])
    assert each(2, two)[0, 0].tolist() == [2.0, 40.0]


def test_few_vehicles_are_told_of_nobody():
    """With `least_count` not even that nobody was there is told."""
    made, geometry = driven({5: UPSTREAM, 6: 0}), SHORT_HIGHWAY.geometry
    for least, expected in ((0, [1.0, 72.0]), (1, [1.0, 72.0]), (2, [np.nan, np.nan])):
        loops = Loops((0.0,), interval=20, least_count=least)
        told = readings(made, Stations.of(loops, geometry), loops)[:, 0]
        np.testing.assert_array_equal(told[0], expected)
        np.testing.assert_array_equal(told[1], [0.0 if least == 0 else np.nan, np.nan])


def test_an_interval_that_the_record_does_not_end_is_not_told():
    road = SHORT_ROAD.replaced(loops=Loops((0.0,), interval=15))
    assert read(road, driven({5: UPSTREAM, 6: 0, 35: UPSTREAM, 36: 0}))[..., 0].sum() == 1.0


def test_a_measured_field_says_of_nobody_who_passes():
    field = Record(n_steps=41, n_columns=SHORT_COLUMNS, field=np.zeros((41, SHORT_COLUMNS, 2)))
    with pytest.raises(ValueError, match=r"corridor\.loops needs the vehicles of a record"):
        read(SHORT_ROAD, field)
