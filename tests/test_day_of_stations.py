"""A day of synthetic stations: rows late, lost and out of order, a restart, a change of the clock.

The table is drawn by a seed: five stations on 5 km, minute by minute, a queue in the morning that
grows upstream of 4 km, and one station that is off for two hours.
"""

import datetime as dt

import numpy as np
import pytest

from dptse_env import RoadEstimator, station
from dptse_env.traffic import Corridor
from tests.helpers import fast_and_slow

PLACES = (0.5, 1.5, 2.5, 3.5, 4.5)
WINTER, SUMMER = (dt.timezone(dt.timedelta(hours=hours)) for hours in (1, 2))
MIDNIGHT = dt.datetime(2026, 3, 29, tzinfo=WINTER)
CHANGE = 120
"""Minute at which clocks are put forward."""
ROAD = Corridor.from_fields(
    {
        "name": "day",
        "n_mainline": 20,
        "segment_length": 0.25,
        "speed_limit": 100,
        "duration": 3600,
        "demand": {"mainline": [[0, 1000]], "on_ramps": []},
    }
)


def traffic(km, second):
    """Flow [veh/h] and speed [km/h] at places and a second of the day."""
    hour = second / 3600.0
    flow = 800.0 + 3000.0 * np.exp(-(((hour - 8.0) / 3.0) ** 2))
    tail = 4.0 - 3.0 * np.clip(min(hour - 7.0, 9.5 - hour), 0.0, 1.0)  # of the queue [km]
    queued = (tail < km) & (km < 4.0)
    return np.where(queued, 0.7 * flow, flow), np.where(queued, 25.0, 95.0 - flow / 500.0)


def minutes(first, hours):
    """Ends of the minutes of some hours of the day."""
    return range(round(60 * first) + 1, round(60 * (first + hours)) + 1)


def day(seed, first, hours):
    """Rows (minute at which it comes in, ISO time of its end, km, count, speed), as they come."""
    rng, rows = np.random.default_rng(seed), []
    for end in minutes(first, hours):
        zone = WINTER if end < CHANGE else SUMMER
        local = (MIDNIGHT + dt.timedelta(minutes=end)).astimezone(zone)
        for km in PLACES:
            flow, speed = traffic(np.array(km), 60 * end - 30)
            count, late = int(rng.poisson(flow / 60.0)), int(rng.choice([0, 0, 0, 0, 1, 4]))
            off = km == PLACES[2] and 9 * 60 <= end < 11 * 60
            if off or rng.random() < 0.02:
                continue
            mean = float(speed + rng.normal(0.0, 6.0 / np.sqrt(max(count, 1)))) if count else None
            rows.append((end + late, local.isoformat(), km, count, mean))
    return sorted(rows, key=lambda row: row[0])


@pytest.mark.parametrize(("first", "hours"), fast_and_slow([(0, 24), (1.6, 0.8)], [(1.6, 0.8)]))
@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_a_day_of_stations_is_followed(first, hours):
    start = int(MIDNIGHT.timestamp()) + round(3600 * first)

    def make():
        return RoadEstimator(ROAD, "asm", stations=PLACES, start=start)

    road, middles, errors, sizes = make(), 0.25 * np.arange(20) + 0.125, [], []
    rows = iter([*day(0, first, hours), None])
    row = next(rows)
    for minute in minutes(first, hours):
        seen = []
        while row is not None and row[0] <= minute:
            _, time, km, count, speed = row
            until = int(dt.datetime.fromisoformat(time).timestamp())
            seen.append(station(km, count=count, speed=speed, seconds=60, until=until))
            row = next(rows)
        road.step(seen, seconds=60)
        if minute % 31 == 0:
            state, road = road.save(), make()
            road.load(state)
            sizes.append(len(state))
        found = road.estimate(delay=60)
        flow, speed = traffic(middles, 60 * (minute - 1))
        inner = slice(3, 17)
        errors.append(
            [
                (found.density - flow / speed)[inner] / found.density_std[inner],
                (found.speed - speed)[inner] / found.speed_std[inner],
                (found.speed - speed)[inner],
            ]
        )
    assert road.time == start + round(3600 * hours)
    density, speed, off = np.sqrt(np.mean(np.square(errors[20:]), axis=(0, 2)))
    assert max(density, speed) < 1.0  # no worse than it says
    assert off < 15.0  # [km/h], 27 while there is a queue
    assert max(sizes) < 1.3 * min(sizes)
