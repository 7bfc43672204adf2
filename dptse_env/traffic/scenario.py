"""Scenarios: departures, routes and the incident of one traffic seed.

All of it comes from numpy generators seeded by the traffic seed, so a scenario does not depend on
SUMO, which simulates the driving only.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.demand import (
    Demand,
    DemandDistribution,
    Incident,
    IncidentDistribution,
    value_at,
)
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import integer

MAINLINE = -1
"""Origin or exit of a vehicle that enters or leaves by the mainline instead of a ramp."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """Realised demand and incident of a corridor under one traffic seed.

    Attributes:
        seed: the traffic seed.
        demand: the realised mean rates.
        incidents: the realised incidents.
        departures: (V,) desired departure times [s], non-decreasing; a vehicle's index is its id.
        origins: (V,) index of the on-ramp, or `MAINLINE`.
        exits: (V,) index of the off-ramp, or `MAINLINE`.
        classes: (V,) index into the corridor's vehicle classes.
        sumo_seed: seed of SUMO's random desired speeds.
        scale: factor on the corridor's demand [-].

    On a road that is recorded from SUMO files of its own (`Corridor.sumo`), the vehicles are
    those of the files, and departures, origins, exits and classes are empty.
    """

    seed: int
    demand: Demand
    incidents: tuple[Incident, ...]
    departures: NDArray[np.float64]
    origins: NDArray[np.int64]
    exits: NDArray[np.int64]
    classes: NDArray[np.int64]
    sumo_seed: int
    scale: float = 1.0


def draw_scenario(corridor: Corridor, seed: int) -> Scenario:
    """Draw the scenario of a traffic seed; the same seed gives the same scenario.

    Demand, incident, arrivals, SUMO and classes have separate random streams, so that a change of
    one does not affect the others.

    Raises:
        ValueError: The seed is not an integer >= 0.
    """
    integer("traffic seed", seed, 0)
    demand_seed, incident_seed, arrival_seed, sumo_seed, class_seed = np.random.SeedSequence(
        seed
    ).spawn(5)
    demand, scale = corridor.conditions.demand, 1.0
    if isinstance(demand, DemandDistribution):
        scale = demand.draw_scale(np.random.default_rng(demand_seed))
        demand = demand.base.scaled(scale)
    generator = np.random.default_rng(incident_seed)
    incidents = tuple(
        each.draw(generator) if isinstance(each, IncidentDistribution) else each
        for each in corridor.conditions.incidents
    )
    generator = np.random.default_rng(arrival_seed)
    duration = corridor.conditions.duration if corridor.sumo is None else 0
    departures, origins = _arrivals(demand, duration, generator)
    return Scenario(
        seed=seed,
        demand=demand,
        incidents=incidents,
        departures=departures,
        origins=origins,
        exits=_exits(corridor, demand, departures, origins, generator),
        classes=_classes(corridor, len(departures), np.random.default_rng(class_seed)),
        sumo_seed=int(np.random.default_rng(sumo_seed).integers(2**31 - 1)),
        scale=scale,
    )


def _arrivals(
    demand: Demand, duration: float, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Poisson arrivals of every entry, merged in order of time."""
    profiles = [(MAINLINE, demand.mainline)]
    profiles += enumerate(demand.ramp_profiles)
    times, origins = [np.empty(0)], [np.empty(0, dtype=np.int64)]
    for origin, profile in profiles:
        ends = [*(time for time, _ in profile[1:]), duration]
        for (start, rate), end in zip(profile, ends, strict=True):
            length = max(min(end, duration) - start, 0.0)
            count = int(generator.poisson(rate * length / HOUR))
            times.append(start + length * generator.random(count))
            origins.append(np.full(count, origin, dtype=np.int64))
    # SUMO's clock counts milliseconds; rounding here keeps its files and this array the same.
    departures = np.concatenate(times).round(3)
    order = np.argsort(departures, kind="stable")
    return departures[order], np.concatenate(origins)[order]


def _exits(
    corridor: Corridor,
    demand: Demand,
    departures: NDArray[np.float64],
    origins: NDArray[np.int64],
    generator: np.random.Generator,
) -> NDArray[np.int64]:
    """Let each vehicle choose at each diverge that it passes, until it has left."""
    road = corridor.geometry
    entry_face = np.array([*road.on_ramps, 0], dtype=np.int64)[origins]
    exits = np.full(len(origins), MAINLINE, dtype=np.int64)
    profiles = demand.exit_shares or tuple(((0.0, share),) for share in road.exit_shares)
    for ramp, (face, profile) in enumerate(zip(road.off_ramps, profiles, strict=True)):
        leaves = generator.random(len(origins)) < value_at(profile, departures)
        exits[leaves & (exits == MAINLINE) & (entry_face < face)] = ramp
    return exits


def _classes(
    corridor: Corridor, n_vehicles: int, generator: np.random.Generator
) -> NDArray[np.int64]:
    """Draw the class of each vehicle."""
    shares = [each.share for each in corridor.conditions.vehicle_classes] or [1.0]
    bounds = np.cumsum(shares)[:-1]
    classes: NDArray[np.int64] = np.searchsorted(bounds, generator.random(n_vehicles), side="right")
    return classes
