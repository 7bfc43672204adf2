"""Random highways of some three kilometres, of several kinds.

They are drawn for training and for judging alike: the numbers of highways keep both apart.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from dptse_env.traffic import Conditions, Corridor, Geometry, Scales
from dptse_env.traffic.demand import Demand, Drivers, Incident, VehicleClass
from dptse_env.utils.units import HOUR

Kind = Literal["queues", "lorries", "convoys", "compliance", "weaving", "autobahn"]
"""Kind of a highway.

- ``queues``: queues at bottlenecks, most of them at the downstream end.
- ``lorries``: up to 40 % of lorries of 75 to 95 km/h in free traffic, on limits of 100 to 130 km/h
  and none.
- ``convoys``: few vehicles of 25 to 50 km/h, or a load for which a stretch of road moves slowly.
- ``compliance``: drivers whose free speed is 0.7 to 1.15 of the limit.
- ``weaving``: an on-ramp 500 m ahead of an off-ramp, on four or five lanes.
- ``autobahn``: three lanes, half of them without a limit, with lorries.
"""

DURATION, WARM_UP = 1150, 100
"""Length of a highway's record, and of its beginning in which the road fills [s]."""
LANES, LENGTHS, LIMITS = (1, 6), (0.05, 0.25), (60.0, 200.0)
"""Ranges of lanes, lengths of segments [km] and speed limits [km/h]."""
KILOMETRES = (2.5, 4.0)
"""Range of the length of a highway [km]."""
CAPACITY = 1950.0
"""Flow of a lane [veh/h] that demands are drawn as shares of."""
HEADWAYS = {"W99": (0.7, 1.6), "IDM": (0.9, 1.9), "Krauss": (0.8, 1.6)}
"""Desired time headways of drivers by their model [s]."""
LORRIES, LORRY_SPEEDS = (0.0, 0.4), (75.0, 95.0)
"""Ranges of the share of lorries, and of their largest speed [km/h]."""
CONVOYS, LOADS = (25.0, 50.0), (20.0, 50.0)
"""Ranges of the speeds of convoys and of moving loads [km/h]."""
QUEUE_LORRIES = (0.03, 0.2)
"""Range of the share of lorries on highways with queues."""
FREE_SPEEDS = (0.7, 1.15)
"""Range of the speed that drivers want, over the limit."""
UNLIMITED = (150.0, 180.0, 200.0)
"""Limits that stand for none [km/h]."""


@dataclass(frozen=True)
class Highway:
    """A highway as it is simulated, and the limit that is published of it.

    Attributes:
        corridor: The simulated one; its limit is the mean speed that drivers want.
        limit: The published limit [km/h].
    """

    corridor: Corridor
    limit: float


def draw_highway(number: int, kind: Kind = "queues") -> Highway:
    """Return the highway of a number, always the same one."""
    if kind == "queues":
        corridor = _draw_queues(number)
        return Highway(corridor, corridor.geometry.largest_speed_limit)
    return _draw_free(np.random.default_rng([79, KINDS.index(kind), number]), number, kind)


def _draw_queues(number: int) -> Corridor:
    """Draw a highway with queues.

    Bottlenecks are temporary limits, most of them at the downstream end; more than half of them
    alternate every 20 to 90 s and send waves upstream. In one of seven there is little traffic.
    """
    rng = np.random.default_rng([77, number])
    length = round(float(np.exp(rng.uniform(*np.log(LENGTHS)))), 3)
    n = max(round(float(rng.uniform(*KILOMETRES)) / length), 13)
    most = int(rng.choice(np.arange(1, 7), p=[0.05, 0.15, 0.25, 0.25, 0.2, 0.1]))
    lanes: Any = most
    if most > 1 and rng.random() < 0.2:
        drop = int(rng.integers(n // 3, n))
        lanes = (most,) * drop + (most - 1,) * (n - drop)
    limit = float(rng.choice([60, 70, 80, 90, 100, 102, 105, 110, 120, 130]))
    model = str(rng.choice(["W99", "IDM", "Krauss"], p=[0.4, 0.35, 0.25]))
    classes: tuple[VehicleClass, ...] = ()
    if rng.random() < 0.4:
        trucks = round(float(rng.uniform(*QUEUE_LORRIES)), 3)
        slow = VehicleClass("truck", trucks, length=12.0, largest_speed=90.0)
        classes = (VehicleClass("car", 1.0 - trucks), slow)
    faces = _draw_ramps(rng, n)
    on = tuple(face for face, is_entry in faces if is_entry)
    off = tuple(face for face, is_entry in faces if not is_entry)
    demand = _draw_demand(rng, CAPACITY * most, len(on))
    geometry = Geometry(
        n_mainline=n,
        on_ramps=on,
        off_ramps=off,
        exit_shares=tuple(round(float(rng.uniform(0.03, 0.2)), 3) for _ in off),
        lanes=lanes,
        segment_length=length,
        speed_limit=limit,
    )
    conditions = Conditions(
        demand=demand,
        incident=_draw_bottlenecks(rng, n),
        duration=DURATION,
        drivers=Drivers(
            model=model,  # type: ignore[arg-type]
            headway=round(float(rng.uniform(*HEADWAYS[model])), 2),
            speed_deviation=round(float(rng.uniform(0.04, 0.18)), 3),
        ),
        vehicle_classes=classes,
    )
    scales = Scales.of(geometry, average_dwell=8.0)
    return Corridor(f"highway-{number}", geometry, conditions, scales)


def _draw_ramps(rng: np.random.Generator, n: int) -> list[tuple[int, bool]]:
    """Return faces of ramps with whether it is an on-ramp; none on half of the highways."""
    if rng.random() < 0.5:
        return []
    count = int(rng.integers(1, min(7, n // 3)))
    faces = sorted(rng.choice(np.arange(2, n - 1), size=count, replace=False).tolist())
    return [(face, bool(rng.random() < 0.5)) for face in faces]


def _draw_demand(rng: np.random.Generator, capacity: float, n_on_ramps: int) -> Demand:
    kind = rng.choice(["heavy", "medium", "night"], p=[0.65, 0.2, 0.15])
    low, high = {"heavy": (0.6, 1.0), "medium": (0.15, 0.75), "night": (0.0, 0.0)}[str(kind)]
    changes = rng.choice(np.arange(100, DURATION - 100, 50), int(rng.integers(1, 4)), replace=False)
    rates = [
        float(np.exp(rng.uniform(np.log(100.0), np.log(1200.0))))
        if kind == "night"
        else float(capacity * rng.uniform(low, high))
        for _ in range(len(changes) + 1)
    ]
    ramps = (20.0, 100.0) if kind == "night" else (150.0, 900.0)
    return Demand(
        mainline=tuple(
            zip([0.0, *np.sort(changes).tolist()], np.round(rates).tolist(), strict=True)
        ),
        on_ramps=tuple(round(float(rng.uniform(*ramps)), 0) for _ in range(n_on_ramps)),
    )


def _draw_rates(
    rng: np.random.Generator, mean: float, n_on_ramps: int, at_ramps: tuple[float, float]
) -> Demand:
    """Return a demand that changes once or not at all."""
    times = (0.0, float(rng.integers(300, DURATION - 200)))
    mainline = tuple((time, round(float(mean * rng.uniform(0.75, 1.25)))) for time in times)
    entering = tuple(round(float(rng.uniform(*at_ramps)), 0) for _ in range(n_on_ramps))
    return Demand(mainline, entering)


def _draw_bottlenecks(rng: np.random.Generator, n: int) -> tuple[Incident, ...]:
    found = []
    for k in range(int(rng.choice([0, 1, 2, 3], p=[0.07, 0.4, 0.35, 0.18]))):
        anywhere = int(rng.integers(n // 4, n))
        segment = anywhere if k else int(rng.choice([anywhere, n - 1, n - 2]))
        time = float(rng.uniform(0, 500)) if rng.random() < 0.6 else 5.0
        alternates, low = rng.random() < 0.6, float(rng.uniform(4, 40))
        end, phases = min(time + rng.uniform(150, 1100), DURATION - 30), []
        while time < end:
            until = time + float(rng.uniform(20, 90) if alternates else rng.uniform(60, 300))
            limit = float(np.clip(low * rng.uniform(0.3, 1.8), 3, 60))
            phases.append((round(time, 1), round(until, 1), round(limit, 1)))
            time = until + (float(rng.uniform(20, 120)) if rng.random() < 0.15 else 0.0)
        found.append(Incident(segment, tuple(phases)))
    return tuple(found)


KINDS: tuple[Kind, ...] = get_args(Kind)
"""All kinds; those after the first one are mostly free traffic."""


def _draw_free(rng: np.random.Generator, number: int, kind: Kind) -> Highway:
    """Draw a highway of another kind than ``queues``."""
    length = round(float(np.exp(rng.uniform(np.log(0.08), np.log(LENGTHS[1])))), 3)
    n = max(round(float(rng.uniform(*KILOMETRES)) / length), 13)
    free, limit = _draw_limit(rng, kind)
    faces = _draw_ramps(rng, n) if rng.random() < 0.5 else []
    lanes: Any = int(rng.choice([2, 3], p=[0.7, 0.3]))
    exits, at_ramps = (0.03, 0.2), (150.0, 700.0)
    busy = {"weaving": (0.4, 0.8), "autobahn": (0.2, 0.95)}.get(kind, (0.1, 0.75))
    if kind == "autobahn":
        lanes = 3
    elif kind == "weaving":
        first, lanes = int(rng.integers(n // 4, n // 2)), int(rng.integers(4, 6))
        faces, exits, at_ramps = [(first, True)], (0.12, 0.3), (500.0, 1400.0)
        faces.append((first + max(round(0.5 / length), 1), False))
        if rng.random() < 0.5:  # with a lane of its own, which makes five
            aside = range(faces[0][0], faces[1][0])
            lanes = tuple(5 if k in aside else 4 for k in range(n))
    most = max(lanes) if isinstance(lanes, tuple) else lanes
    on, off = (tuple(face for face, enters in faces if enters is way) for way in (True, False))
    demand = _draw_rates(rng, CAPACITY * most * rng.uniform(*busy), len(on), at_ramps)
    incident = _draw_bottlenecks(rng, n) if rng.random() < 0.2 else ()
    classes = _draw_lorries(rng, 0.3 if kind in ("compliance", "weaving") else LORRIES[1])
    if kind == "convoys" and rng.random() < 0.5:
        incident = _draw_load(rng, n, length)
    elif kind == "convoys":
        slow = round(float(rng.uniform(0.001, 0.006)), 4)
        car = dataclasses.replace(classes[0], share=classes[0].share - slow)
        speed = round(float(rng.uniform(*CONVOYS)), 1)
        classes = (car, *classes[1:], VehicleClass("convoy", slow, 12.0, largest_speed=speed))
    model = str(rng.choice(["W99", "IDM", "Krauss"], p=[0.4, 0.35, 0.25]))
    geometry = Geometry(
        n_mainline=n,
        on_ramps=on,
        off_ramps=off,
        exit_shares=tuple(round(float(rng.uniform(*exits)), 3) for _ in off),
        lanes=lanes,
        segment_length=length,
        speed_limit=free,
    )
    drivers = Drivers(
        model=model,  # type: ignore[arg-type]
        headway=round(float(rng.uniform(*HEADWAYS[model])), 2),
        speed_deviation=round(float(rng.uniform(0.04, 0.18)), 3),
    )
    conditions = Conditions(demand, DURATION, incident, drivers, classes)
    scales = Scales.of(geometry, average_dwell=8.0)
    return Highway(Corridor(f"{kind}-{number}", geometry, conditions, scales), limit)


def _draw_limit(rng: np.random.Generator, kind: Kind) -> tuple[float, float]:
    """Return the mean speed that drivers want, and the published limit [km/h]."""
    low = {"lorries": 100.0, "autobahn": 120.0}.get(kind, 80.0)
    limit = float(rng.choice(np.arange(low, 131.0, 10.0)))
    if kind in ("lorries", "autobahn") and rng.random() < 0.4:
        return round(float(rng.uniform(120.0, 145.0)), 1), float(rng.choice(UNLIMITED))
    share = (
        rng.uniform(*FREE_SPEEDS)
        if kind == "compliance"
        else rng.choice([1.0, rng.uniform(0.85, 1.1)])
    )
    return round(float(limit * share), 1), limit


def _draw_lorries(rng: np.random.Generator, most: float) -> tuple[VehicleClass, ...]:
    """Return cars, and a share of lorries of one speed."""
    share, speed = round(float(rng.uniform(LORRIES[0], most)), 3), rng.uniform(*LORRY_SPEEDS)
    if share == 0.0:
        return (VehicleClass("car", 1.0),)
    lorry = VehicleClass("lorry", share, 12.0, largest_speed=round(float(speed), 1))
    return VehicleClass("car", 1.0 - share), lorry


def _draw_load(rng: np.random.Generator, n: int, length: float) -> tuple[Incident, ...]:
    """Return limits that move along the road with a load, over some 300 m of it."""
    speed, start = float(rng.uniform(*LOADS)), float(rng.uniform(100.0, 500.0))
    crossing, behind = HOUR * length / speed, HOUR * 0.3 / speed
    limits: list[Incident] = []
    for k in range(int(rng.integers(0, n // 2)), n):
        time = start + crossing * len(limits)
        if time + behind >= DURATION - 30:
            break
        limits.append(Incident(k, ((round(time, 1), round(time + behind, 1), round(speed, 1)),)))
    return tuple(limits)
