"""Corridors: geometry, demand and incident of a road.

Segments are numbered from 0: the mainline first, then the on-ramps, then the off-ramps, each in the
direction of travel. A ramp at face j sits between the mainline segments j-1 and j. Around these S
segments lie boundary segments that are recorded but not estimated: one upstream and one downstream
of the mainline, one before every on-ramp and one after every off-ramp. A boundary segment has
length, lanes and limit of the segment that it lies next to.
"""

import dataclasses
import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Self, TypeVar

from dptse_env.road import Road, make_road
from dptse_env.traffic.demand import (
    Demand,
    DemandDistribution,
    Drivers,
    Incident,
    IncidentDistribution,
    Share,
    VehicleClass,
)
from dptse_env.traffic.own_sumo import SumoScenario
from dptse_env.utils.fields import Interval, checked_fields, from_mapping, integer, require

T = TypeVar("T")

NOT_TRAFFIC = (
    "name", "fixed_sensors", "density_scale", "speed_scale", "average_dwell", "measured",
)  # fmt: skip
"""Fields that describe the observation of the traffic and do not change the traffic itself."""

GEOMETRY = (
    "n_mainline", "on_ramps", "off_ramps", "exit_shares", "lanes", "ramp_lanes", "segment_length",
    "speed_limit", "ramp_segments", "ramp_length", "ramp_speed_limit",
)  # fmt: skip
"""Fields by which a corridor is another road: what was fitted to one may not suit another."""

Face = Annotated[int, Interval(1, 999)]
"""Number of a face between two mainline segments."""
Lanes = Annotated[int, Interval(1, 16)]
"""Number of lanes."""
# SUMO cannot drive an edge shorter than about a vehicle and its gap.
SHORTEST_SEGMENT = 0.04
"""Length of a segment at least [km]."""
Length = Annotated[float, Interval(SHORTEST_SEGMENT, 10)]
"""Length of a segment [km]."""
SpeedLimit = Annotated[float, Interval(1, 1000)]
"""A speed limit [km/h]."""
RampSegments = Annotated[int, Interval(1, 100)]
"""Number of segments of a ramp."""

UNIFORM = {"ramp_length": None, "ramp_speed_limit": None, "ramp_segments": 1}
"""Fields of ramps that do not enter a digest where they have these values."""


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
class Corridor:
    """A stretch of highway with ramps, its demand and its incident.

    Lengths, lanes and speed limits are one value for all mainline segments or a sequence with one
    for each; those of ramps one value for all ramps or a sequence with one for each, on-ramps
    first. A sequence of equal values is the same as the value.

    Attributes:
        name: lower-case letters, digits and hyphens.
        n_mainline: number N of mainline segments, at least 2.
        on_ramps: face of each on-ramp, in 1..N-1, increasing.
        off_ramps: face of each off-ramp, in 1..N-1, increasing, none shared with an on-ramp.
        exit_shares: share in (0, 1) of the vehicles passing each off-ramp that take it.
        demand: arrival rates, fixed or drawn per traffic seed.
        incident: a temporary speed limit, fixed or drawn per traffic seed, or several of them; None
            for free traffic.
        fixed_sensors: indices of the segments measured at every step.
        duration: length of a record [s].
        lanes: lanes of the mainline; where they get fewer, the leftmost ones end.
        ramp_lanes: lanes of the ramps, at most those of the mainline segment that they join or
            leave.
        segment_length: length of the mainline's segments [km].
        speed_limit: speed limit of the mainline outside incidents [km/h].
        ramp_segments: number of segments of the ramps.
        ramp_length: length of a ramp's segments [km]; None for that of the mainline segment that
            it joins or leaves.
        ramp_speed_limit: speed limit of the ramps [km/h]; None for that of the same segment.
        density_scale: constant that scales densities in rewards and observations [veh/km].
        speed_scale: constant that scales speeds in rewards and observations [km/h].
        average_dwell: T_avg of the paper's eq. (6): average time of a vehicle on a mainline
            segment [s], measured from records (`dptse_env.traffic.average_dwell`).
        drivers: the car-following model of all vehicles.
        network: SUMO files of one's own, from which the road is recorded; None for a network made
            of the fields above. With files, the vehicles are those of the files: the rates of
            `demand` are what is published of them, the range of a `DemandDistribution` scales them
            (SUMO's ``--scale``), `exit_shares` are published too, an incident limits the vehicles
            on its segment, and `drivers` must be left at its default.
        vehicle_classes: classes of vehicles, whose shares add up to 1; none where all vehicles are
            alike.
        recordings: imported traffic that episodes replay; None where SUMO simulates the traffic.
            With recordings the demand is a description of them, and there is no incident.
        measured: names of the fields above, and of keywords of an environment, whose values were
            measured on the records of this road, as imports and ``dptse fit`` write down. They void
            a guarantee for the vehicles of these records.

    Raises:
        ValueError: The geometry is impossible, or demand, incident or sensors do not fit it.
    """

    name: str
    n_mainline: Annotated[int, Interval(2, 1000)]
    on_ramps: tuple[Face, ...]
    off_ramps: tuple[Face, ...]
    exit_shares: tuple[Share, ...]
    demand: Demand | DemandDistribution
    incident: Incident | IncidentDistribution | tuple[Incident | IncidentDistribution, ...] | None
    fixed_sensors: tuple[Annotated[int, Interval(0, 2997)], ...]
    duration: Annotated[int, Interval(1, 100_000)]
    lanes: Lanes | tuple[Lanes, ...] = 3
    ramp_lanes: Lanes | tuple[Lanes, ...] = 1
    segment_length: Length | tuple[Length, ...] = 0.1
    speed_limit: SpeedLimit | tuple[SpeedLimit, ...] = 102.0
    density_scale: Annotated[float, Interval(1, 100_000)] = 333.0
    speed_scale: Annotated[float, Interval(1, 1000)] = 102.0
    average_dwell: Annotated[float, Interval(0.01, 1e6)] = 8.0
    drivers: Drivers = field(default_factory=Drivers)
    ramp_segments: RampSegments | tuple[RampSegments, ...] = 1
    ramp_length: Length | tuple[Length, ...] | None = None
    ramp_speed_limit: SpeedLimit | tuple[SpeedLimit, ...] | None = None
    network: SumoScenario | None = None
    recordings: Recordings | None = None
    vehicle_classes: tuple[VehicleClass, ...] = ()
    measured: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "corridor")
        is_name = bool(re.fullmatch(r"[a-z0-9][a-z0-9-]*", self.name))
        self._require(is_name, "name", "lower-case letters, digits and hyphens")
        self._check_ramps()
        self._check_profiles()
        for i, sensor in enumerate(self.fixed_sensors):
            integer(f"corridor.fixed_sensors[{i}]", sensor, 0, self.n_segments - 1)
        unique = len(set(self.fixed_sensors)) == len(self.fixed_sensors)
        self._require(unique, "fixed_sensors", "free of duplicates")
        demand = self.published_demand
        allowed = f"one rate for each of the {self.n_on_ramps} on-ramps"
        fits = len(demand.on_ramps) == self.n_on_ramps
        require(fits, "corridor.demand.on_ramps", allowed, demand.on_ramps)
        allowed = f"steps for each of the {self.n_off_ramps} off-ramps"
        fits = demand.exit_shares is None or len(demand.exit_shares) == self.n_off_ramps
        require(fits, "corridor.demand.exit_shares", allowed, demand.exit_shares)
        if isinstance(self.incident, tuple) and len(self.incident) < 2:
            # One incident in a sequence is the incident, and an empty sequence is none.
            object.__setattr__(self, "incident", self.incident[0] if self.incident else None)
        for incident in self.incidents:
            self._check_incident(incident)
        self._check_sources()

    def _require(self, condition: bool, name: str, allowed: str) -> None:
        """Raise ``ValueError`` with the value of a field unless a condition holds."""
        require(condition, f"corridor.{name}", allowed, getattr(self, name))

    def _check_ramps(self) -> None:
        for name in ("on_ramps", "off_ramps"):
            faces = getattr(self, name)
            for i, face in enumerate(faces):
                integer(f"corridor.{name}[{i}]", face, 1, self.n_mainline - 1)
            self._require(list(faces) == sorted(set(faces)), name, "increasing")
        disjoint = not set(self.on_ramps) & set(self.off_ramps)
        self._require(disjoint, "off_ramps", f"at other faces than the on-ramps {self.on_ramps}")
        fits = len(self.exit_shares) == self.n_off_ramps
        allowed = f"one share for each of the {self.n_off_ramps} off-ramps"
        self._require(fits, "exit_shares", allowed)

    def _check_profiles(self) -> None:
        """Check what varies along the road, and collapse sequences of equal values."""
        counts = dict.fromkeys(("lanes", "segment_length", "speed_limit"), self.n_mainline)
        counts |= dict.fromkeys(("ramp_lanes", *UNIFORM), self.n_ramps)
        for name, count in counts.items():
            values = getattr(self, name)
            if not isinstance(values, tuple):
                continue
            each = "mainline segment" if count == self.n_mainline else "ramp"
            allowed = f"one value, or {count}, one for each {each}"
            self._require(len(values) == count, name, allowed)
            if len(set(values)) == 1:
                object.__setattr__(self, name, values[0])
        lanes = self.segment_lanes
        for face, beside, segments in self.ramps():
            allowed = f"<= {lanes[beside]} lanes at face {face}"
            most = lanes[segments[0]]
            require(most <= lanes[beside], "corridor.ramp_lanes", allowed, most)

    def _check_incident(self, incident: Incident | IncidentDistribution) -> None:
        if isinstance(incident, Incident):
            segments, start = [incident.segment], incident.start
        else:
            segments, start = list(incident.segments), incident.start[1]
        for segment in segments:
            integer("corridor.incident.segment", segment, 0, self.n_mainline - 1)
        require(start < self.duration, "corridor.incident.start", f"< {self.duration} s", start)

    def _check_sources(self) -> None:
        """Check what traffic that is imported, or recorded from files of one's own, excludes."""
        if self.recordings is not None:
            self._require(self.incident is None, "incident", "None where traffic is recorded")
            fixed = isinstance(self.demand, Demand)
            self._require(fixed, "demand", "fixed where traffic is recorded")
        if self.network is not None:
            columns, n_columns = len(self.network.columns), self.record_shape[1]
            allowed = f"one for each of the {n_columns} record columns of this geometry"
            require(columns == n_columns, "corridor.network.columns", allowed, columns)
            without = "on a road with a network of its own"
            self._require(self.recordings is None, "recordings", f"None {without}")
            self._require(self.drivers == Drivers(), "drivers", f"left out {without}")
        if self.vehicle_classes:
            simulated = self.network is None and self.recordings is None
            allowed = "left out where the traffic has classes of its own"
            self._require(simulated, "vehicle_classes", allowed)
            names = {each.name for each in self.vehicle_classes}
            different = len(names) == len(self.vehicle_classes)
            self._require(different, "vehicle_classes", "classes of different names")
            total = math.fsum(each.share for each in self.vehicle_classes)
            complete, allowed = math.isclose(total, 1.0, abs_tol=1e-9), "whose shares add up to 1"
            require(complete, "corridor.vehicle_classes", f"classes {allowed}", total)

    def has_geometry_of(self, other: Self) -> bool:
        """Return whether another corridor is the same road, whatever drives on it."""
        return all(getattr(self, name) == getattr(other, name) for name in GEOMETRY)

    def replaced(self, fields: Mapping[str, Any]) -> Self:
        """Return the corridor with other fields, plain JSON; scales follow lanes and speed limit.

        Raises:
            ValueError: A field is unknown or out of range.
        """
        road = from_mapping(type(self), fields, "corridor", self)
        scales: dict[str, Any] = {}
        if "lanes" in fields:
            scales["density_scale"] = self.density_scale * (road.most_lanes / self.most_lanes)
        if "speed_limit" in fields:
            ratio = road.largest_speed_limit / self.largest_speed_limit
            scales["speed_scale"] = self.speed_scale * ratio
        return dataclasses.replace(road, **{k: v for k, v in scales.items() if k not in fields})

    @cached_property
    def road(self) -> Road:
        """The geometry as arrays."""
        return make_road(self)

    @property
    def n_on_ramps(self) -> int:
        """Number I of on-ramps."""
        return len(self.on_ramps)

    @property
    def n_off_ramps(self) -> int:
        """Number O of off-ramps."""
        return len(self.off_ramps)

    @property
    def n_segments(self) -> int:
        """Number S of segments that are estimated: those of the mainline and of all ramps."""
        return self.n_mainline + sum(self._per_ramp(self.ramp_segments))

    @property
    def n_ramps(self) -> int:
        """Number I + O of ramps."""
        return self.n_on_ramps + self.n_off_ramps

    @property
    def n_boundaries(self) -> int:
        """Number R = 2 + I + O of boundary segments around them."""
        return 2 + self.n_ramps

    @cached_property
    def on_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        """Segments of each on-ramp, in the direction of travel."""
        return self._ramp_segments[: self.n_on_ramps]

    @cached_property
    def off_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        """Segments of each off-ramp, in the direction of travel."""
        return self._ramp_segments[self.n_on_ramps :]

    @cached_property
    def _ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        counts = self._per_ramp(self.ramp_segments)
        firsts = itertools.accumulate(counts, initial=self.n_mainline)
        return tuple(
            tuple(range(first, first + count)) for first, count in zip(firsts, counts, strict=False)
        )

    @cached_property
    def segment_lengths(self) -> tuple[float, ...]:
        """Length [km] of each of the S segments."""
        return self._along(self.segment_length, self.ramp_length)

    @cached_property
    def segment_lanes(self) -> tuple[int, ...]:
        """Lanes of each of the S segments."""
        return self._along(self.lanes, self.ramp_lanes)

    @cached_property
    def speed_limits(self) -> tuple[float, ...]:
        """Speed limit [km/h] of each of the S segments, outside incidents."""
        return self._along(self.speed_limit, self.ramp_speed_limit)

    @cached_property
    def boundary_neighbours(self) -> tuple[int, ...]:
        """Segment next to each of the R boundary segments."""
        before = [segments[0] for segments in self.on_ramp_segments]
        after = [segments[-1] for segments in self.off_ramp_segments]
        return (0, self.n_mainline - 1, *before, *after)

    @property
    def boundary_lanes(self) -> tuple[int, ...]:
        """Lanes of each of the R boundary segments."""
        return tuple(self.segment_lanes[s] for s in self.boundary_neighbours)

    def with_boundaries(self, values: Sequence[T]) -> tuple[T, ...]:
        """Return values of the S segments, followed by those of the R boundary segments."""
        return (*values, *(values[s] for s in self.boundary_neighbours))

    @property
    def most_lanes(self) -> int:
        """Largest number of lanes of the mainline."""
        return max(self.segment_lanes[: self.n_mainline])

    @property
    def largest_speed_limit(self) -> float:
        """Largest speed limit of the road [km/h]."""
        return max(self.speed_limits)

    def ramps(self) -> Iterator[tuple[int, int, tuple[int, ...]]]:
        """Yield each ramp's face, the mainline segment that it joins or leaves, its segments."""
        faces = [*self.on_ramps, *self.off_ramps]
        beside = [*self.on_ramps, *(face - 1 for face in self.off_ramps)]
        yield from zip(faces, beside, self._ramp_segments, strict=True)

    def _per_ramp(self, values: T | tuple[T, ...]) -> tuple[T, ...]:
        return values if isinstance(values, tuple) else (values,) * self.n_ramps

    def _along(
        self, values: T | tuple[T, ...], of_ramps: T | tuple[T, ...] | None
    ) -> tuple[T, ...]:
        """Return values of the S segments, given those of the mainline and of ramps."""
        n = self.n_mainline
        mainline = values if isinstance(values, tuple) else (values,) * n
        if of_ramps is None:
            of_ramps = tuple(mainline[beside] for _, beside, _ in self.ramps())
        ramps = zip(self._per_ramp(of_ramps), self._ramp_segments, strict=True)
        return (*mainline, *(value for value, segments in ramps for _ in segments))

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

    @property
    def record_shape(self) -> tuple[int, int]:
        """Number of steps of a record, the second 0 among them, and of its columns, S + R."""
        return self.duration + 1, self.n_segments + self.n_boundaries

    @property
    def record_layout(self) -> dict[str, Any]:
        """The fields that the columns and the length of a record depend on, as plain JSON."""
        return {
            "n_mainline": self.n_mainline,
            "on_ramps": list(self.on_ramps),
            "off_ramps": list(self.off_ramps),
            "ramp_segments": [len(segments) for segments in self._ramp_segments],
            "segment_lengths": list(self.segment_lengths),
            "duration": self.duration,
        }

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the fields that determine the traffic, stable across processes.

        The fields of `NOT_TRAFFIC` are left out: corridors that differ in these alone share their
        records. With a `network`, its files, the demand's scale, the incident and the duration
        determine the traffic.
        """
        content = dataclasses.asdict(self)
        for name in NOT_TRAFFIC:
            del content[name]
        if self.drivers == Drivers():
            del content["drivers"]  # as in digests from before drivers could be chosen
        if not self.vehicle_classes:
            del content["vehicle_classes"]  # likewise
        for name, value in UNIFORM.items():
            if content[name] == value:
                del content[name]  # as before ramps could differ
        demand = content["demand"].get("base", content["demand"])
        if demand["exit_shares"] is None:
            del demand["exit_shares"]  # as before shares could vary
        del content["network"]  # as before there were any
        if self.recordings is None:
            del content["recordings"]  # likewise
        else:
            content["recordings"] = self.recordings.digest  # not the folder, which may be moved
        if self.network is not None:
            scale = self.demand.scale if isinstance(self.demand, DemandDistribution) else None
            content = {
                "network": self.network.traffic,
                "scale": scale,
                "incident": content["incident"],
                "duration": self.duration,
            }
        kinds = [type(each).__name__ for each in self.incidents] or ["NoneType"]
        content["kinds"] = [type(self.demand).__name__, *kinds]
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()
