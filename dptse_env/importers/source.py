"""Description of a file of trajectories: format, columns, units, and the road's place in it.

It can be given as a TOML file with the fields of `Source`; ``docs/guides/your-data.md`` has
examples.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Annotated

from dptse_env.utils.validation import (
    Interval,
    checked_fields,
    from_mapping,
    read_toml,
    require,
    require_name,
    within,
)

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "frame": 0.0}
"""Units of times in seconds; frames need a `Source.frame_rate`."""
LENGTHS = {"m": 1e-3, "km": 1.0, "ft": 0.0003048, "mi": 1.609344}
"""Units of lengths in kilometres."""
SPEEDS = {"m/s": 3.6, "km/h": 1.0, "ft/s": 1.09728, "mi/h": 1.609344}
"""Units of speeds in km/h."""
UNITS = {"time": TIMES, "length": LENGTHS, "speed": SPEEDS}

NUMBERS = ("time", "x", "y", "speed", "extent")
LABELS = ("vehicle", "lane", "edge", "group")
ROLES = NUMBERS + LABELS
"""Roles of columns. ``x`` is the position along the road, along an ``edge`` of a SUMO net, or, with
``y``, in the plane; else ``y`` is lateral. ``extent`` is the length of a vehicle along ``x``, for
data in which ``x`` is a corner of its box. A ``group`` is a road of its own in the file, such as a
driving direction."""


class TrajectoryError(ValueError):
    """A file cannot be imported; the message names it, and row and field where there are some."""


@dataclass(frozen=True)
class Strip:
    """A strip of the road; one without lanes and range has all vehicles that no other has.

    Attributes:
        lanes: names of its lanes.
        lateral: range of lateral positions, in the file's unit of length.
    """

    lanes: tuple[int | str, ...] = ()
    lateral: tuple[float, float] | None = None

    @property
    def names(self) -> frozenset[str]:
        """Names of the lanes as text."""
        return frozenset(map(str, self.lanes))

    def __str__(self) -> str:
        """Describe it for messages."""
        lanes = f"lanes {', '.join(map(str, self.lanes))}" if self.lanes else ""
        lateral = f"lateral positions {self.lateral}" if self.lateral else ""
        return " and ".join(filter(None, (lanes, lateral))) or "all other vehicles"


@dataclass(frozen=True)
class Layout:
    """Position of the road in the data. Lengths are in the file's unit.

    Attributes:
        origin: position of the upstream end of the first mainline segment.
        reversed: whether positions decrease in the direction of travel.
        extent: in data with both directions, the position at which that against x begins.
        centre_line: points of the road's axis in the plane, in the direction of travel. Positions
            and lateral positions, positive to the left, are then those of the projection on it.
        mainline: lanes or lateral range of the mainline.
        on_ramps: the same for each on-ramp. A ramp's vehicles count as the mainline's from its
            face on.
        off_ramps: the same for each off-ramp, whose vehicles count as the mainline's before it.
        edges: for data by edges of a SUMO net, where each edge lies: the name of a record column
            (``main_3``, ``on_0``, ``upstream``, ``before_on_0``, ...), or the kilometre of the
            mainline at which the edge starts. By default edges have the names of the columns.
    """

    origin: float = 0.0
    reversed: bool = False
    extent: float | None = None
    centre_line: tuple[tuple[float, float], ...] = ()
    mainline: Strip = field(default_factory=Strip)
    on_ramps: tuple[Strip, ...] = ()
    off_ramps: tuple[Strip, ...] = ()
    edges: dict = field(default_factory=dict)  # type: ignore[type-arg]

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "layout")
        line = self.centre_line
        require(len(line) != 1, "layout.centre_line", "two points or more, or none", line)
        for name, value in self.edges.items():
            known = isinstance(value, str | int | float) and not isinstance(value, bool)
            allowed = "the name of a column or a number of kilometres"
            require(known, f"layout.edges.{name}", allowed, value)


@dataclass(frozen=True)
class Source:
    """Meaning of a file of trajectories.

    Attributes:
        format: name of the format; see `dptse_env.importers.FORMATS`.
        columns: name of the file's column by role (`ROLES`); changes those of the format.
        units: unit by quantity, ``time``, ``length`` and ``speed``; changes those of the format.
        where: values that columns must have; other rows are left out.
        groups: separate roads in the file that are wanted, such as ``lower`` for one driving
            direction of highD; empty for all.
        frame_rate: frames a second, where times are frames.
        time_shift: added to all times [s]; None for what the format has.
        layout: where the road lies.
    """

    format: str
    columns: dict = field(default_factory=dict)  # type: ignore[type-arg]
    units: dict = field(default_factory=dict)  # type: ignore[type-arg]
    where: dict = field(default_factory=dict)  # type: ignore[type-arg]
    groups: tuple[int | str, ...] = ()
    frame_rate: Annotated[float, Interval(0.01, 10_000)] = 25.0
    time_shift: float | None = None
    layout: Layout = field(default_factory=Layout)

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "source")
        for role, column in self.columns.items():
            require_name("source.columns", role, ROLES)
            require(isinstance(column, str), f"source.columns.{role}", "a column's name", column)
        for quantity, unit in self.units.items():
            require_name("source.units", quantity, UNITS)
            require_name(f"source.units.{quantity}", unit, UNITS[quantity])

    def factor(self, quantity: str, default: str) -> float:
        """Return the factor of a quantity to s, km or km/h, given the format's unit."""
        unit = self.units.get(quantity, default)
        return 1.0 / self.frame_rate if unit == "frame" else UNITS[quantity][unit]


def read_source(path: str | os.PathLike[str]) -> Source:
    """Read a TOML file with the fields of `Source`.

    Raises:
        ValueError: It cannot be read, is no TOML, or a field is unknown or out of range; the
            message starts with the file's path.
    """
    content = read_toml(path, "mapping")
    with within(f"{path}: "):
        return from_mapping(Source, content, "source")
