"""The corridors that come with the package.

Their `average_dwell` is measured on the training seeds 0..15, by
``python scripts/record.py --corridor NAME --seeds 0:16``; a test repeats the measurement.
"""

import dataclasses
from typing import Any

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.demand import Demand, DemandDistribution
from dptse_env.traffic.incident import Incident, IncidentDistribution
from dptse_env.traffic.road_files import is_road_file, read_corridor
from dptse_env.utils.registry import Registry

PAPER_HIGHWAY = Corridor(
    name="paper-highway",
    n_mainline=15,
    on_ramps=(3, 9),
    off_ramps=(6, 12),
    exit_shares=(0.1, 0.1),
    demand=Demand(
        mainline=((0.0, 2050.0), (200.0, 6050.0), (400.0, 2050.0)), on_ramps=(320.0, 300.0)
    ),
    incident=Incident(segment=10, phases=((200.0, 400.0, 10.08), (400.0, 500.0, 50.95))),
    fixed_sensors=(14, 17, 18),
    duration=700,
    average_dwell=10.25,
)
"""The paper's 1.5 km stretch (section IV), its demand and its incident on segment 11.

The paper does not state the three lanes, the exit shares of 10 % and the end after 700 s.
"""

SHORT_HIGHWAY = Corridor(
    name="short-highway",
    n_mainline=6,
    on_ramps=(2,),
    off_ramps=(4,),
    exit_shares=(0.1,),
    demand=Demand(mainline=((0.0, 1800.0), (60.0, 3000.0), (150.0, 1500.0)), on_ramps=(300.0,)),
    incident=Incident(segment=4, phases=((60.0, 140.0, 12.0), (140.0, 170.0, 50.0))),
    fixed_sensors=(5, 7),
    duration=240,
    lanes=2,
    density_scale=222.0,
    average_dwell=9.95,
)
"""A 0.6 km stretch with one ramp of each kind and a jam, for tests and first trials."""

LONG_HIGHWAY = Corridor(
    name="long-highway",
    n_mainline=120,
    on_ramps=(24, 52, 80, 108),
    off_ramps=(20, 48, 76, 104),
    exit_shares=(0.1, 0.1, 0.1, 0.1),
    demand=DemandDistribution(
        Demand(
            mainline=((0.0, 3000.0), (300.0, 5000.0), (750.0, 3000.0)),
            on_ramps=(400.0, 400.0, 400.0, 400.0),
        )
    ),
    incident=(
        IncidentDistribution(tuple(range(10, 60)), start=(300.0, 700.0)),
        IncidentDistribution(tuple(range(60, 119)), start=(400.0, 800.0)),
    ),
    fixed_sensors=(119, 124, 125, 126, 127),
    duration=1200,
    average_dwell=4.9,
)
"""A 12 km stretch with four interchanges; demand level and two incidents vary with the seed."""

SHIPPED_CORRIDORS = (PAPER_HIGHWAY, SHORT_HIGHWAY, LONG_HIGHWAY)
"""Corridors whose compiled networks come with the package."""

CORRIDORS = Registry(
    "corridor",
    {corridor.name: corridor for corridor in SHIPPED_CORRIDORS},
    check=lambda part: (
        None if isinstance(part, Corridor) or callable(part) else "be a Corridor, or return one"
    ),
)
"""Corridors by name."""


def find_corridor(value: Any) -> Corridor:
    """Return a corridor by name, of a road file, by ``"package.module:NAME"``, or as it is.

    A string that ends in ``.toml`` is a road file (`dptse_env.traffic.road_files`); a function
    returns the corridor.

    Raises:
        ValueError: There is none, or it is no `Corridor`.
    """
    if is_road_file(value):
        return read_corridor(value)
    corridor = CORRIDORS.find(value)
    if not isinstance(corridor, Corridor) and callable(corridor):
        corridor = corridor()
    if not isinstance(corridor, Corridor):
        raise ValueError(f"corridor {value!r} must be a Corridor, or return one, got {corridor!r}")
    return corridor


def randomised(corridor: Corridor) -> Corridor:
    """Return `corridor` with a random demand level and incident for every traffic seed.

    The demand varies by a fifth either way. The incident may block any mainline segment but the
    last, at any time that leaves a third of the record for the jam, with ranges in proportion to
    the record's duration. The demand of `corridor` is the base of the distribution; its incident is
    dropped. Other fields are unchanged, also `average_dwell`, which should be measured again.
    """
    base, total = corridor.published_demand, corridor.duration
    incident = IncidentDistribution(
        segments=tuple(range(corridor.n_mainline - 1)),
        start=(0.1 * total, 0.65 * total),
        duration=(0.1 * total, 0.4 * total),
        recovery_duration=(0.05 * total, 0.2 * total),
    )
    return dataclasses.replace(corridor, demand=DemandDistribution(base), incident=incident)
