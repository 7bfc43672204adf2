"""Recording from SUMO files of one's own, as they are.

The network, its internal links, routes, vehicle types and options are those of the files. Three
things differ from ``sumo -c``: the seed is that of the traffic seed, the demand may be scaled, and
nothing is written: output options are refused, and what additional files would write goes nowhere.
"""

import gzip
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.incident import Incident
from dptse_env.traffic.record import Record
from dptse_env.traffic.scenario import Scenario
from dptse_env.traffic.sumo_scenario import Places, SumoScenario

QUIET = (
    "--no-step-log",
    "--duration-log.disable",
    "--no-warnings",
    "--xml-validation=never",
    "--xml-validation.net=never",
    "--xml-validation.routes=never",
)
"""Options of every recording. Validation would look for schemas under SUMO_HOME."""

KMH = 3.6
"""Factor from m/s to km/h."""

READ_BY = frozenset(["rerouter", "variableSpeedSign", "vss", "include"])
"""Elements of routes and additional files whose ``file`` is read; of all others it is written."""

_WRITTEN = ("file", "output", "dest")


def command(folder: Path, network: SumoScenario, scenario: Scenario) -> list[str]:
    """Return SUMO's command line for a scenario.

    Args:
        folder: an empty folder, for copies of additional files.
        network: the files, which are checked against their digests.
        scenario: gives SUMO's seed and the scale of the demand.

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
        *("sumo", *files, "--seed", str(scenario.sumo_seed), "--scale", f"{scenario.scale:.6g}"),
        *("--begin", str(network.begin - network.warm_up), "--step-length"),
        *(f"{network.step_length:g}", *network.options, *QUIET),
    ]


def seconds(libsumo: ModuleType, network: SumoScenario, duration: int) -> Iterator[int]:
    """Advance a loaded simulation to the end of the warm-up, and then second by second.

    Yields:
        0, 1, ..., `duration`: the second [s] of the record whose state libsumo holds.
    """
    for _ in range(network.warm_up * network.substeps):
        libsumo.simulationStep()
    yield 0
    for second in range(duration):
        for _ in range(network.substeps):
            libsumo.simulationStep()
        yield second + 1


def observe(libsumo: ModuleType, corridor: Corridor, scenario: Scenario) -> Record:
    """Run the loaded simulation to its end and collect the vehicle table.

    Vehicles are numbered in the order in which they appear on the road.
    """
    network = corridor.network
    assert network is not None
    places, vehicle = Places(network.columns), libsumo.vehicle
    vehicles_on, position_of = libsumo.edge.getLastStepVehicleIDs, vehicle.getLanePosition
    limits = VehicleLimits(libsumo, scenario.incidents)
    numbers: dict[str, int] = {}
    rows: list[tuple[float, float, float, float]] = []
    for second in seconds(libsumo, network, corridor.duration):
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
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 4).T
    step, number, column, speed = table[:, np.lexsort((table[2], table[0]))]
    return Record(
        step=step, vehicle=number, segment=column, speed=speed,
        n_steps=corridor.duration + 1, n_columns=len(network.columns),
    )  # fmt: skip


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
            if (limit := self._limit(second, segment)) is not None
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

    def _limit(self, second: int, segment: int) -> float | None:
        """Return the lowest limit of incidents on a segment at a second [km/h], if there is one."""
        limits = [
            limit
            for incident in self._incidents
            if incident.segment == segment
            for start, end, limit in incident.phases
            if start <= second < end
        ]
        return min(limits, default=None)


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
