"""Corridors: a road, what drives on it, its scales, and where its records come from.

A `Corridor` has a part for each of the first three. Keywords of ``gym.make`` and road files name
the fields of the parts without the part, as in ``corridor={"lanes": 2, "duration": 300}``.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Self

from dptse_env.geometry import Geometry
from dptse_env.road import Road, make_road
from dptse_env.traffic.demand import (
    Demand,
    DemandDistribution,
    Drivers,
    Incident,
    IncidentDistribution,
    VehicleClass,
)
from dptse_env.traffic.loops import Loops, Stations
from dptse_env.traffic.own_sumo import SumoScenario
from dptse_env.utils.files import json_digest
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import (
    Interval,
    checked_fields,
    cut,
    field_hints,
    from_mapping,
    integer,
    require,
)

DENSITY_SCALE = 111.0
"""Scale of densities for each lane [veh/km]."""

ASSUMED_PACE = 3.0
"""Assumed ratio of the average dwell to the time of a crossing at the speed limit, where nobody
gives the dwell. Records of the shipped roads, with their jams, have 2.8 to 2.9."""


@dataclass(frozen=True)
class Conditions:
    """Traffic of a road, and its duration.

    Attributes:
        demand: arrival rates, fixed or drawn per traffic seed.
        duration: length of a record [s].
        incident: a temporary speed limit, fixed or drawn per traffic seed, or several of them; None
            for free traffic.
        drivers: the car-following model of all vehicles.
        vehicle_classes: classes of vehicles, whose shares add up to 1; none where all vehicles are
            alike.

    Raises:
        ValueError: An incident begins after the end, or classes do not add up.
    """

    demand: Demand | DemandDistribution
    duration: Annotated[int, Interval(1, 100_000)]
    incident: (
        Incident | IncidentDistribution | tuple[Incident | IncidentDistribution, ...] | None
    ) = None
    drivers: Drivers = field(default_factory=Drivers)
    vehicle_classes: tuple[VehicleClass, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "corridor")
        if isinstance(self.incident, tuple) and len(self.incident) < 2:
            # One incident in a sequence is the incident, and an empty sequence is none.
            object.__setattr__(self, "incident", self.incident[0] if self.incident else None)
        for incident in self.incidents:
            start = incident.start if isinstance(incident, Incident) else incident.start[1]
            require(start < self.duration, "corridor.incident.start", f"< {self.duration} s", start)
        if self.vehicle_classes:
            names = {each.name for each in self.vehicle_classes}
            different = len(names) == len(self.vehicle_classes)
            path, allowed = "corridor.vehicle_classes", "classes of different names"
            require(different, path, allowed, self.vehicle_classes)
            total = math.fsum(each.share for each in self.vehicle_classes)
            complete, allowed = math.isclose(total, 1.0, abs_tol=1e-9), "whose shares add up to 1"
            require(complete, path, f"classes {allowed}", total)

    @property
    def published_demand(self) -> Demand:
        """The public demand: the base of a `DemandDistribution`, or else the demand itself."""
        demand = self.demand
        return demand.base if isinstance(demand, DemandDistribution) else demand

    @property
    def incidents(self) -> tuple[Incident | IncidentDistribution, ...]:
        """The incidents, of any number."""
        if self.incident is None:
            return ()
        return self.incident if isinstance(self.incident, tuple) else (self.incident,)


@dataclass(frozen=True)
class Recordings:
    """A folder of imported records, real or foreign traffic that episodes replay.

    Attributes:
        folder: the folder; in a road file it may be relative to that file.
        digest: SHA-256 (hex) of the digests of all records and of the road that they are made
            for, from the folder's manifest.
    """

    folder: str
    digest: str

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "corridor.recordings")


@dataclass(frozen=True)
class Scales:
    """Constants of a road that scale errors, observations and noise.

    Attributes:
        density_scale: constant that scales densities in rewards and observations [veh/km].
        speed_scale: constant that scales speeds in rewards and observations [km/h].
        average_dwell: T_avg of the paper's eq. (6): average time of a vehicle on a mainline
            segment [s], measured from records (`dptse_env.traffic.average_dwell`).
    """

    density_scale: Annotated[float, Interval(1, 100_000)]
    speed_scale: Annotated[float, Interval(1, 1000)]
    average_dwell: Annotated[float, Interval(0.01, 1e6)]

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "corridor")

    @classmethod
    def of(cls, geometry: Geometry, average_dwell: float | None = None) -> Self:
        """Return the scales that follow from lanes and speed limits.

        Args:
            geometry: The road.
            average_dwell: The measured dwell [s]; None for `ASSUMED_PACE` times the time of a
                crossing at the speed limit.
        """
        n = geometry.n_mainline
        sections = zip(geometry.segment_lengths[:n], geometry.speed_limits[:n], strict=True)
        crossing = sum(HOUR * length / limit for length, limit in sections) / n
        dwell = ASSUMED_PACE * crossing if average_dwell is None else average_dwell
        return cls(DENSITY_SCALE * geometry.most_lanes, geometry.largest_speed_limit, dwell)

    def moved(self, before: Geometry, after: Geometry) -> Self:
        """Return the scales of another road, in proportion to lanes and speed limits."""
        return dataclasses.replace(
            self,
            density_scale=self.density_scale * (after.most_lanes / before.most_lanes),
            speed_scale=self.speed_scale * (after.largest_speed_limit / before.largest_speed_limit),
        )


@dataclass(frozen=True)
class Corridor:
    """A stretch of highway with ramps, and its traffic.

    Attributes:
        name: lower-case letters, digits and hyphens.
        geometry: segments, ramps, lanes and speed limits.
        conditions: demand, incident and vehicles.
        scales: constants that scale errors, observations and noise.
        sumo: SUMO files of one's own, from which the road is recorded; None for a net that is made
            of the corridor's geometry. With files, the vehicles are those of the files: the rates
            of `demand` are what is published of them, the range of a `DemandDistribution` scales
            them (SUMO's ``--scale``), `exit_shares` are published too, an incident limits the
            vehicles on its segment, and `drivers` must be left at its default.
        recordings: imported traffic that episodes replay; None where SUMO simulates the traffic.
            With recordings the demand is a description of them, and there is no incident.
        fixed_sensors: indices of the segments measured at every step.
        loops: stations of loops at borders of segments; None for none.
        measured: names of fields of the parts, and of keywords of an environment, whose values were
            measured on vehicles of files, as imports and fits of these write down. They void a
            guarantee for the vehicles of these records.

    Raises:
        ValueError: Demand, incident, sensors or files do not fit the road, or both `sumo` and
            `recordings` are given.
    """

    name: str
    geometry: Geometry
    conditions: Conditions
    scales: Scales
    sumo: SumoScenario | None = None
    recordings: Recordings | None = None
    fixed_sensors: tuple[Annotated[int, Interval(0, 2997)], ...] = ()
    loops: Loops | None = None
    measured: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "corridor")
        is_name = bool(re.fullmatch(r"[a-z0-9][a-z0-9-]*", self.name))
        require(is_name, "corridor.name", "lower-case letters, digits and hyphens", self.name)
        for i, sensor in enumerate(self.fixed_sensors):
            integer(f"corridor.fixed_sensors[{i}]", sensor, 0, self.geometry.n_segments - 1)
        unique = len(set(self.fixed_sensors)) == len(self.fixed_sensors)
        require(unique, "corridor.fixed_sensors", "free of duplicates", self.fixed_sensors)
        if self.loops is not None:
            object.__setattr__(self, "loops", self.loops.at_borders(self.geometry))
            duration, interval = self.conditions.duration, self.loops.interval
            allowed = f"<= {duration} s, the length of a record"
            require(interval <= duration, "corridor.loops.interval", allowed, interval)
        self._check_conditions()
        self._check_origin()

    def _check_conditions(self) -> None:
        """Check that demand and incidents fit the geometry."""
        road, demand = self.geometry, self.conditions.published_demand
        allowed = f"one rate for each of the {len(road.on_ramps)} on-ramps"
        fits = len(demand.on_ramps) == len(road.on_ramps)
        require(fits, "corridor.demand.on_ramps", allowed, demand.on_ramps)
        allowed = f"steps for each of the {len(road.off_ramps)} off-ramps"
        fits = demand.exit_shares is None or len(demand.exit_shares) == len(road.off_ramps)
        require(fits, "corridor.demand.exit_shares", allowed, demand.exit_shares)
        for each in self.conditions.incidents:
            segments = [each.segment] if isinstance(each, Incident) else each.segments
            for segment in segments:
                integer("corridor.incident.segment", segment, 0, road.n_mainline - 1)

    def _check_origin(self) -> None:
        """Check what traffic that is imported, or recorded from files of one's own, excludes."""
        conditions, sumo, recordings = self.conditions, self.sumo, self.recordings
        one, allowed = (
            sumo is None or recordings is None,
            "None on a road with SUMO files of its own",
        )
        require(one, "corridor.recordings", allowed, recordings)
        if recordings is not None:
            free, allowed = conditions.incident is None, "None where traffic is recorded"
            require(free, "corridor.incident", allowed, conditions.incident)
            fixed = isinstance(conditions.demand, Demand)
            allowed = "fixed where traffic is recorded"
            require(fixed, "corridor.demand", allowed, conditions.demand)
        if sumo is not None:
            columns, n_columns = len(sumo.columns), self.geometry.n_cells
            allowed = f"one for each of the {n_columns} record columns of this geometry"
            require(columns == n_columns, "corridor.sumo.columns", allowed, columns)
            plain, allowed = conditions.drivers == Drivers(), "left out on a road with SUMO files"
            require(plain, "corridor.drivers", f"{allowed} of its own", conditions.drivers)
        fits = not conditions.vehicle_classes or (sumo is None and recordings is None)
        allowed = "left out where the traffic has classes of its own"
        require(fits, "corridor.vehicle_classes", allowed, conditions.vehicle_classes)

    @classmethod
    def hints(cls) -> dict[str, Any]:
        """Return the annotations of all fields by name, those of the parts instead of the parts."""
        hints: dict[str, Any] = {}
        for name, hint in field_hints(cls).items():
            hints |= field_hints(hint) if name in PARTS else {name: hint}
        return hints

    def fields(self) -> dict[str, Any]:
        """Return all fields by name, plain JSON, those of the parts instead of the parts."""
        content: dict[str, Any] = {}
        for name, value in dataclasses.asdict(self).items():
            content |= value if name in PARTS else {name: value}
        return content

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any], base: Self | None = None) -> Self:
        """Return the corridor of fields by name, as `fields` has them.

        Args:
            fields: The fields, plain JSON or instances.
            base: Supplies those that are left out. Scales that are left out follow lanes and speed
                limits; see `Scales`.

        Raises:
            ValueError: A field is unknown, missing or out of range; the message starts with
                ``corridor``.
        """
        known = cls.hints()
        for key in fields:
            if key not in known:
                raise ValueError(f"corridor.{cut(key)} is unknown; allowed: {', '.join(known)}")

        def part(kind: Any, base: Any) -> Any:
            given = {name: fields[name] for name in field_hints(kind) if name in fields}
            return from_mapping(kind, given, "corridor", base)

        geometry = part(Geometry, base and base.geometry)
        scales = base.scales.moved(base.geometry, geometry) if base else Scales.of(geometry)
        own = {
            "geometry": geometry,
            "conditions": part(Conditions, base and base.conditions),
            "scales": part(Scales, scales),
        }
        own |= {name: fields[name] for name in field_hints(cls) if name in fields}
        return from_mapping(cls, own, "corridor", base)

    def replaced(self, **fields: Any) -> Self:
        """Return the corridor with other fields; see `from_fields`."""
        return self.from_fields(fields, self)

    @cached_property
    def road(self) -> Road:
        """The geometry as arrays."""
        return make_road(self.geometry)

    @cached_property
    def stations(self) -> Stations:
        """The stations of its loops."""
        return Stations.of(self.loops, self.geometry)

    @property
    def record_shape(self) -> tuple[int, int]:
        """Number of steps of a record, the second 0 among them, and of its columns, S + R."""
        return self.conditions.duration + 1, self.geometry.n_cells

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of what determines the traffic, stable across processes.

        Corridors with the same geometry, conditions and recordings share their records. With a
        `sumo`, its files, the demand's scale, the incident and the duration determine them.
        """
        content = dataclasses.asdict(self)
        conditions, sumo = content["conditions"], self.sumo
        if sumo is not None:
            return json_digest(
                {
                    "sumo": sumo.traffic,
                    "scale": conditions["demand"].get("scale"),
                    "incident": conditions["incident"],
                    "duration": conditions["duration"],
                }
            )
        recordings = self.recordings  # not the folder, which may be moved
        return json_digest(
            {
                "geometry": content["geometry"],
                "conditions": conditions,
                "recordings": None if recordings is None else recordings.digest,
            }
        )


PARTS = ("geometry", "conditions", "scales")
"""Fields of a `Corridor` whose fields keywords and road files name without the part."""
