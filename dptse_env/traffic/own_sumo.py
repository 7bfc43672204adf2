"""SUMO files of one's own: what a road is recorded from in place of a network made for it.

The network, its internal links, routes, vehicle types and options are those of the files. Three
things differ from ``sumo -c``: the seed is that of the traffic seed, the demand may be scaled, and
nothing is written: output options are refused, and what additional files would write goes nowhere.
"""

import gzip
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from types import ModuleType
from typing import Annotated
from xml.etree import ElementTree

from dptse_env.traffic.demand import Incident, lowest_limit
from dptse_env.utils.fields import Interval, checked_fields, require
from dptse_env.utils.files import file_digest

Position = Annotated[float, Interval(0, 1e6)]
"""Place on an edge, from its start [m]."""
Stretch = tuple[str, Position, Position]
"""Part of an edge: its id, and the positions at which the part begins and ends [m]."""
StepLength = Annotated[float, Interval(0.01, 1.0)]
"""Time step of SUMO [s]."""
Clock = Annotated[int, Interval(0, 10_000_000)]
"""Whole seconds of SUMO's clock."""

FORCED = frozenset([
    "n", "r", "a", "c", "b", "e", "S", "net-file", "route-files", "additional-files",
    "configuration-file", "begin", "end", "seed", "random", "scale", "step-length", "no-step-log",
    "duration-log.disable", "no-warnings", "xml-validation", "xml-validation.net",
    "xml-validation.routes",
])  # fmt: skip
"""Options of SUMO that a recording sets itself."""

WRITES = re.compile(
    r"output|statistic|(^|[.-])log([.-]|$)|^save-state|^(summary|tripinfo|vehroutes?|netstate|ndump)$"
)
"""Options of SUMO that write files, which a recording does not."""

READ_BY = frozenset(["rerouter", "variableSpeedSign", "vss", "include"])
"""Elements of routes and additional files whose ``file`` is read; of all others it is written."""

TOLERANCE = 0.01
"""Precision of lengths in network files [m]."""

KMH = 3.6
"""Factor from m/s to km/h."""

_PATH = "corridor.network"
_WRITTEN = ("file", "output", "dest")


class ChangedFilesError(ValueError):
    """A file that a road is recorded from is missing, or is not the one that was imported."""


@dataclass(frozen=True)
class SumoScenario:
    """SUMO's files for a road, and the places on their edges that a record counts.

    Attributes:
        net: network file.
        routes: route files, in SUMO's order.
        columns: for each record column (the S segments, then the R boundary segments) the stretches
            of edges that belong to it. A vehicle counts where its front bumper is.
        sha256: SHA-256 (hex) of each file: the network, the route files, the additional files.
        folder: folder of the files; in a road file it may be relative to that file. Their names are
            relative to it.
        additional: additional files, in SUMO's order. What they would write is not written.
        begin: second of SUMO's clock at which a record starts.
        warm_up: seconds simulated before that, which are not recorded.
        step_length: SUMO's time step [s]; it divides a second.
        options: further options of SUMO, ``--name=value`` each.

    Raises:
        ValueError: Stretches are empty or overlap, or an option is one that a recording sets.
    """

    net: str
    routes: tuple[str, ...]
    columns: tuple[tuple[Stretch, ...], ...]
    sha256: tuple[str, ...]
    folder: str
    additional: tuple[str, ...] = ()
    begin: Clock = 0
    warm_up: Clock = 0
    step_length: StepLength = 1.0
    options: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, _PATH)
        n_files, n_sums = len(self.files), len(self.sha256)
        require(n_sums == n_files, f"{_PATH}.sha256", f"one for each of {n_files} files", n_sums)
        allowed = f"at most begin = {self.begin} s"
        require(self.warm_up <= self.begin, f"{_PATH}.warm_up", allowed, self.warm_up)
        steps = 1.0 / self.step_length
        allowed = "a whole part of a second"
        require(
            abs(steps - round(steps)) < 1e-9,
            f"{_PATH}.step_length",
            allowed,
            self.step_length,
        )
        self._check_options()
        self._check_columns()

    def _check_options(self) -> None:
        for option in self.options:
            match = re.fullmatch(r"--([a-z][\w.-]*)(=.*)?", option)
            require(match is not None, f"{_PATH}.options", "--name=value each", option)
            assert match is not None
            free = match[1] not in FORCED and not WRITES.search(match[1])
            require(
                free,
                f"{_PATH}.options",
                "free of outputs and of what a recording sets",
                option,
            )

    def _check_columns(self) -> None:
        taken: dict[str, list[tuple[float, float]]] = {}
        for i, stretches in enumerate(self.columns):
            path = f"{_PATH}.columns[{i}]"
            require(bool(stretches), path, "at least one stretch of an edge", stretches)
            for edge, start, end in stretches:
                require(start < end, path, "stretches that end after they start", (start, end))
                taken.setdefault(edge, []).append((start, end))
        for edge, parts in taken.items():
            parts.sort()
            for (_, end), (start, _) in pairwise(parts):
                apart = end <= start + TOLERANCE
                require(
                    apart,
                    f"{_PATH}.columns",
                    f"without overlap on edge {edge!r}",
                    (start, end),
                )

    @property
    def files(self) -> tuple[str, ...]:
        """Names of all files: the network, the route files, the additional files."""
        return (self.net, *self.routes, *self.additional)

    @property
    def substeps(self) -> int:
        """Number of SUMO's steps in a second."""
        return round(1.0 / self.step_length)

    @property
    def traffic(self) -> dict[str, object]:
        """Description of what determines the traffic: contents of files, not their names."""
        n_routes = len(self.routes)
        return {
            "net": self.sha256[0],
            "routes": self.sha256[1 : 1 + n_routes],
            "additional": self.sha256[1 + n_routes :],
            "begin": self.begin,
            "warm_up": self.warm_up,
            "step_length": self.step_length,
            "options": self.options,
            "columns": self.columns,
        }

    def path(self, name: str) -> Path:
        """Return the path of a file."""
        return Path(self.folder) / name

    def check_files(self) -> None:
        """Compare the files with those that were imported.

        Raises:
            ChangedFilesError: A file cannot be read, or its content is another.
        """
        for name, expected in zip(self.files, self.sha256, strict=True):
            path = self.path(name)
            try:
                found = file_digest(path)
            except OSError as error:
                raise ChangedFilesError(f"{path}: cannot be read: {error.strerror}") from error
            if found != expected:
                raise ChangedFilesError(
                    f"{path}: is not the file that the road was made from (its SHA-256 is {found}, "
                    f"not {expected}); import the road again"
                )


class Places:
    """Places of the record columns on the edges of a network.

    Args:
        columns: as in `SumoScenario`.
    """

    def __init__(self, columns: tuple[tuple[Stretch, ...], ...]) -> None:
        """Sort the stretches by edge."""
        parts: dict[str, list[tuple[float, float, int]]] = {}
        for column, stretches in enumerate(columns):
            for edge, start, end in stretches:
                parts.setdefault(edge, []).append((start, end, column))
        self._parts = {edge: sorted(of_edge) for edge, of_edge in parts.items()}

    def __iter__(self) -> Iterator[str]:
        """Iterate over the edges, by the first column that each is a part of."""
        return iter(self._parts)

    def find(self, edge: str, position: float) -> int | None:
        """Return the column of a position [m] on an edge; None where nothing is recorded."""
        parts = self._parts[edge]
        index = bisect_right(parts, position + TOLERANCE, key=itemgetter(0)) - 1
        if index < 0 or position > parts[index][1] + TOLERANCE:
            return None
        return parts[index][2]


def command(folder: Path, network: SumoScenario, seed: int, scale: float) -> list[str]:
    """Return SUMO's command line.

    Args:
        folder: an empty folder, for copies of additional files.
        network: the files, which are checked against their digests.
        seed: SUMO's seed.
        scale: factor on the demand [-].

    Raises:
        ChangedFilesError: A file is missing or has changed.
        ValueError: An additional file is no XML.
    """
    network.check_files()
    files = ["-n", str(network.path(network.net))]
    if network.routes:
        files += ["-r", ",".join(str(network.path(name)) for name in network.routes)]
    if network.additional:
        copies = [
            _without_outputs(network.path(name), folder / f"additional-{i}.xml")
            for i, name in enumerate(network.additional)
        ]
        files += ["-a", ",".join(map(str, copies))]
    return [
        *("sumo", *files, "--seed", str(seed), "--scale", f"{scale:.6g}"),
        *("--begin", str(network.begin - network.warm_up)),
        *("--step-length", f"{network.step_length:g}", *network.options),
    ]


def observe(
    libsumo: ModuleType,
    network: SumoScenario,
    incidents: Sequence[Incident],
    seconds: Iterable[int],
) -> list[tuple[int, int, int, float]]:
    """Run the loaded simulation to its end.

    Vehicles are numbered in the order in which they appear on the road.

    Args:
        libsumo: the module, with a simulation.
        network: the places of the record's columns.
        incidents: the incidents.
        seconds: the seconds of the record, which advance the simulation.

    Returns:
        A row for each vehicle and second: second, vehicle, column of the record, speed [km/h].
    """
    places, vehicle = Places(network.columns), libsumo.vehicle
    vehicles_on, position_of = libsumo.edge.getLastStepVehicleIDs, vehicle.getLanePosition
    limits = VehicleLimits(libsumo, incidents)
    numbers: dict[str, int] = {}
    rows: list[tuple[int, int, int, float]] = []
    for second in seconds:
        affected: dict[str, int] = {}
        for edge in places:
            for name in vehicles_on(edge):
                column = places.find(edge, position_of(name))
                if column is None:
                    continue
                number = numbers.setdefault(name, len(numbers))
                rows.append((second, number, column, KMH * vehicle.getSpeed(name)))
                if column in limits.segments:
                    affected[name] = column
        limits.update(second, affected)
    return rows


class VehicleLimits:
    """Limits of incidents, for the vehicles on their segments.

    Edges of one's own network may be much longer than a segment, so limits are not set on them: a
    vehicle has one from the first second at which it is on the segment to the first at which it is
    not.

    Args:
        libsumo: the module, with a simulation.
        incidents: the incidents.

    Attributes:
        segments: the segments with an incident.
    """

    def __init__(self, libsumo: ModuleType, incidents: Sequence[Incident]) -> None:
        """Start without limited vehicles."""
        self.segments = frozenset(incident.segment for incident in incidents)
        self._libsumo = libsumo
        self._incidents = incidents
        self._usual: dict[str, float] = {}

    def update(self, second: int, vehicles: Mapping[str, int]) -> None:
        """Limit vehicles by name on their segments at a second of the record; free all others."""
        vehicle = self._libsumo.vehicle
        limited = {
            name: limit
            for name, segment in vehicles.items()
            if (limit := lowest_limit(self._incidents, segment, second)) is not None
        }
        for name, limit in limited.items():
            usual = self._usual.setdefault(name, vehicle.getMaxSpeed(name))
            vehicle.setMaxSpeed(name, min(limit / KMH, usual))
        free = self._usual.keys() - limited.keys()
        present = set(vehicle.getIDList()) if free else set()
        for name in sorted(free):
            usual = self._usual.pop(name)
            if name in present:
                vehicle.setMaxSpeed(name, usual)


def _without_outputs(path: Path, copy: Path) -> Path:
    """Copy an additional file so that what it would write goes nowhere; return the copy."""
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        try:
            tree = ElementTree.parse(file)
        except ElementTree.ParseError as error:
            raise ValueError(f"{path}: must be XML: {error}") from error
    for element in tree.iter():
        for name in _WRITTEN:
            if name in element.attrib and element.tag not in READ_BY:
                element.set(name, "NUL")
            elif name in element.attrib:
                element.set(name, str((path.parent / element.attrib[name]).absolute()))
    tree.write(copy)
    return copy
