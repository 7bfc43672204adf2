"""SUMO files of one's own: what a road is recorded from in place of a net made for it.

The net, its internal links, routes, vehicle types and options are those of the files. Four
things differ from ``sumo -c``: the seed is that of the traffic seed, the demand may be scaled,
vehicles are in order of departure, and nothing is written. SUMO gets copies of the files that name
no file, and those options alone that change the traffic, in an empty folder.
"""

import gzip
import re
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf
from operator import itemgetter
from pathlib import Path
from types import ModuleType
from typing import Annotated
from xml.etree import ElementTree

from dptse_env.traffic.demand import Incident, lowest_limit
from dptse_env.utils.files import file_digest, open_unzipped
from dptse_env.utils.units import KMH
from dptse_env.utils.validation import Interval, checked_fields, require, shown

Position = Annotated[float, Interval(0, 1e6)]
"""Place on an edge, from its start [m]."""
Stretch = tuple[str, Position, Position]
"""Part of an edge: its id, and the positions at which the part begins and ends [m]."""
StepLength = Annotated[float, Interval(0.01, 1.0)]
"""Time step of SUMO [s]."""
Clock = Annotated[int, Interval(0, 10_000_000)]
"""Whole seconds of SUMO's clock."""

_DEVICES = (
    "battery|bluelight|driverstate|elechybrid|friction|glosa|rerouting|stationfinder|taxi|toc"
)
"""Devices of vehicles that change the traffic; others measure it."""

TRAFFIC = re.compile(
    r"(intermodal-)?collision\..+|default\..+|emergencydecel\..+|extrapolate-departpos|ignore-.+"
    r"|insertion-checks|junction-taz|keep-after-arrival|lanechange\..+|lateral-resolution"
    r"|mapmatch\..+|max-(depart-delay|num-.+)|no-internal-links|overhead-wire\..+|parking\..+"
    r"|pedestrian\.(model|timegap-crossing|striping\..+|jupedsim\.(?!wkt|py).+)|persontrip\..+"
    r"|railsignal([.]|-moving-).+|railway\..+|random-depart-offset|replay-rerouting|ride\..+"
    r"|route-steps|routing-algorithm|scale-suffix|slope-centered|(sloppy|eager|emergency)-insert"
    r"|startup-wait-threshold|step-method\.ballistic|thread-rngs|time-to-(impatience|teleport).*"
    r"|tls\..+|use-stop-.+|waiting-time-memory|weight-attribute|weights\..+"
    rf"|(person-)?device\.({_DEVICES})\.(?!(.+\.)?(file|output)$).+"
)
"""Options of SUMO that change the traffic and name no file. All others write, measure or show
something, read a file that no digest covers, or are set by a recording."""

READ_BY = frozenset(["rerouter", "variableSpeedSign", "vss", "calibrator", "include"])
"""Elements whose ``file`` or ``href`` is read; of all others it is written."""

UNREADABLE = (SyntaxError, LookupError, ValueError, EOFError, zlib.error, gzip.BadGzipFile)
"""Errors of reading a file that is no XML, or is cut or damaged."""

WARNING = "Warning: "
"""Start of a line with a warning of SUMO."""

MOST_KINDS = 5
"""Kinds of warnings that are told."""

TOLERANCE = 0.01
"""Precision of lengths in net files [m]."""

Remark = Callable[[str], object]
"""Takes a sentence for people."""

_PATH = "corridor.sumo"
_FILE = re.compile(r"(^|[._-])(files?|output|dest|href)$|File$|Output$")
"""Attributes, and keys of parameters, that name files."""
_MEASURES = re.compile(rf"(has|(person-)?device)\.(?!({_DEVICES})\.)")
"""Keys of parameters of devices that change no traffic."""
_ELSEWHERE = re.compile(r"\s*([/\\~]|[A-Za-z]:[/\\])|(.*[/\\])?\.\.([/\\]|$)|.*(\$|://)")
"""Values of parameters that name a place outside of the folder that SUMO runs in."""
_INTERVAL = "interval"
_DEPARTURES = {
    **dict.fromkeys(("vehicle", "trip", "person", "container"), "depart"),
    **dict.fromkeys(("flow", "personFlow", "containerFlow", _INTERVAL), "begin"),
}
"""Attribute with the departure, by element."""


class ChangedFilesError(ValueError):
    """A file that a road is recorded from is missing, or is not the one that was imported."""


@dataclass(frozen=True)
class SumoScenario:
    """SUMO's files for a road, and the places on their edges that a record counts.

    Attributes:
        net: net file.
        routes: route files, in SUMO's order.
        columns: for each record column (the S segments, then the R boundary segments) the stretches
            of edges that belong to it. A vehicle counts where its front bumper is.
        sha256: SHA-256 (hex) of each file: the net, the route files, the additional files.
        folder: folder of the files; in a road file it may be relative to that file. Their names are
            relative to it.
        additional: additional files, in SUMO's order.
        begin: second of SUMO's clock at which a record starts.
        warm_up: seconds simulated before that, which are not recorded.
        step_length: SUMO's time step [s]; it divides a second.
        options: further options of SUMO, ``--name=value`` each, that change the traffic.

    Raises:
        ValueError: Stretches are empty or overlap, or an option is none of `TRAFFIC`.
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
        whole, allowed = 1.0 / self.step_length - self.substeps, "a whole part of a second"
        require(abs(whole) < 1e-9, f"{_PATH}.step_length", allowed, self.step_length)
        self._check_options()
        self._check_columns()

    def _check_options(self) -> None:
        for option in self.options:
            match = re.fullmatch(r"--([a-z][\w.-]*)(=.*)?", option)
            require(match is not None, f"{_PATH}.options", "--name=value each", option)
            assert match is not None
            allowed = "options that change the traffic: no outputs, and none that a recording sets"
            require(TRAFFIC.fullmatch(match[1]) is not None, f"{_PATH}.options", allowed, option)

    def _check_columns(self) -> None:
        for i, stretches in enumerate(self.columns):
            path = f"{_PATH}.columns[{i}]"
            require(bool(stretches), path, "at least one stretch of an edge", stretches)
            for _, start, end in stretches:
                require(start < end, path, "stretches that end after they start", (start, end))
        for edge, parts in _by_edge(self.columns).items():
            for (_, end, _), (start, _, _) in pairwise(parts):
                apart, allowed = end <= start + TOLERANCE, f"without overlap on edge {edge!r}"
                require(apart, f"{_PATH}.columns", allowed, (start, end))

    @property
    def files(self) -> tuple[str, ...]:
        """Names of all files: the net, the route files, the additional files."""
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


def _by_edge(
    columns: tuple[tuple[Stretch, ...], ...],
) -> dict[str, list[tuple[float, float, int]]]:
    """Return start, end and column of the stretches of each edge, in the direction of travel."""
    parts: dict[str, list[tuple[float, float, int]]] = {}
    for column, stretches in enumerate(columns):
        for edge, start, end in stretches:
            parts.setdefault(edge, []).append((start, end, column))
    return {edge: sorted(of_edge) for edge, of_edge in parts.items()}


def _column(parts: list[tuple[float, float, int]], position: float) -> int | None:
    """Return the column of a position [m], given an edge's parts; None where there is none."""
    index = bisect_right(parts, position + TOLERANCE, key=itemgetter(0)) - 1
    if index < 0 or position > parts[index][1] + TOLERANCE:
        return None
    return parts[index][2]


def command(folder: Path, files: SumoScenario, seed: int, scale: float) -> list[str]:
    """Return SUMO's command line, whose names of files are relative to a folder, and plain ASCII.

    Args:
        folder: an empty folder, for copies of the files, in which SUMO has to run.
        files: the files, which are checked against their digests.
        seed: SUMO's seed.
        scale: factor on the demand [-].

    Raises:
        ChangedFilesError: A file is missing or has changed.
        ValueError: A file is no XML, or reads another file.
    """
    files.check_files()
    begin, words = files.begin - files.warm_up, ["sumo"]
    for option, names in (("n", (files.net,)), ("r", files.routes), ("a", files.additional)):
        copies = [f"{option}{i}.xml" for i in range(len(names))]
        for name, copy in zip(names, copies, strict=True):
            copy_input(files.path(name), folder / copy, begin)
        words += [f"-{option}", ",".join(copies)] if copies else []
    return [
        *(*words, "--seed", str(seed), "--scale", f"{scale:.6g}", "--begin", str(begin)),
        *("--step-length", f"{files.step_length:g}", *files.options),
    ]


def observe(
    libsumo: ModuleType,
    files: SumoScenario,
    incidents: Sequence[Incident],
    seconds: Iterable[int],
) -> list[tuple[int, int, int, float]]:
    """Run the loaded simulation to its end.

    Vehicles are numbered in the order in which they appear on the road.

    Args:
        libsumo: the module, with a simulation.
        files: the places of the record's columns.
        incidents: the incidents.
        seconds: the seconds of the record, which advance the simulation.

    Returns:
        A row for each vehicle and second: second, vehicle, column of the record, speed [km/h].
    """
    places, vehicle = _by_edge(files.columns), libsumo.vehicle
    vehicles_on, position_of = libsumo.edge.getLastStepVehicleIDs, vehicle.getLanePosition
    limits = VehicleLimits(libsumo, incidents)
    numbers: dict[str, int] = {}
    rows: list[tuple[int, int, int, float]] = []
    for second in seconds:
        affected: dict[str, int] = {}
        for edge, parts in places.items():
            for name in vehicles_on(edge):
                column = _column(parts, position_of(name))
                if column is None:
                    continue
                number = numbers.setdefault(name, len(numbers))
                rows.append((second, number, column, KMH * vehicle.getSpeed(name)))
                if column in limits.segments:
                    affected[name] = column
        limits.update(second, affected)
    return rows


def tell_departures(libsumo: ModuleType, remark: Remark) -> None:
    """Tell how many vehicles a simulation has loaded that have not departed."""
    loaded, departed = (
        int(libsumo.simulation.getParameter("", f"stats.vehicles.{name}"))
        for name in ("loaded", "inserted")
    )
    if departed < loaded:
        remark(f"{loaded - departed} of {loaded} vehicles that SUMO loaded had not departed")


def tell_warnings(messages: Path, remark: Remark) -> None:
    """Tell the most frequent kinds of SUMO's warnings, one of each, in a file of its messages."""
    kinds: dict[str, list[str]] = {}
    for line in messages.read_text(encoding="utf-8", errors="replace").splitlines():
        if line.startswith(WARNING):
            kind = re.sub(r"'[^']*'|[\d.]+", "", line)  # without names and numbers
            kinds.setdefault(kind, []).append(line)
    for lines in sorted(kinds.values(), key=len, reverse=True)[:MOST_KINDS]:
        remark(f"{lines[0]:.300} ({len(lines)} of this kind)")


class VehicleLimits:
    """Limits of incidents, for the vehicles on their segments.

    Edges of one's own net may be much longer than a segment, so limits are not set on them: a
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


@dataclass
class Copied:
    """Differences of a copy for SUMO from its file.

    Attributes:
        n_elements: number of elements at the top.
        is_sorted: whether vehicles were in order of departure before.
        outputs: number of outputs that were taken out, by what writes them.
        reads: elements that read another file, for people.
    """

    n_elements: int = 0
    is_sorted: bool = True
    outputs: Counter[str] = field(default_factory=Counter)
    reads: list[str] = field(default_factory=list)

    def read(self, what: str, name: str) -> None:
        """Note that something reads another file."""
        allowed = f"must not read another file, got {shown(name)}: put its content in its place"
        self.reads.append(f"{what} {allowed}")


def copy_input(path: Path, copy: Path, begin: float) -> Copied:
    """Copy a net, routes or additional elements so that SUMO writes nothing and loses nobody.

    No element of the copy names a file. Vehicles are in order of departure: in a file of routes
    SUMO drops vehicles, and starts flows late, that stand behind later ones.

    Args:
        path: the file, plain or gzipped.
        copy: where the copy goes.
        begin: second of SUMO's clock at which flows begin that do not say when.

    Raises:
        ValueError: It is no XML, or reads another file.
    """
    # What moves, by its departure or, where an event starts it, that of what stands before it. In
    # a file out of order what is defined comes before all of them.
    parts: list[tuple[float, str]] = []
    found, last, depth = Copied(), -inf, 0
    try:
        with open_unzipped(path) as file:
            for event, element in ElementTree.iterparse(file, events=("start", "end")):
                depth += 1 if event == "start" else -1
                if event == "start" and depth == 1:
                    root, head = element, ElementTree.Element(element.tag, dict(element.attrib))
                elif event == "end" and depth == 1:
                    found.n_elements += 1
                    is_left = _without_files(element, found)
                    for part, inner, default in _apart(element, begin) if is_left else ():
                        moves = inner.tag in _DEPARTURES
                        departure = _departure(inner, default) if moves else None
                        if departure is not None:
                            found.is_sorted &= departure >= last
                            last = departure
                        text = ElementTree.tostring(part, encoding="unicode").strip()
                        parts.append((last if moves else -inf, text))
                    root.clear()
    except (*UNREADABLE, RecursionError) as error:
        raise ValueError(f"{path} must be XML: {error!s:.200}") from error
    _without_files(head, found)
    if found.reads:
        raise ValueError(f"{path}: {found.reads[0]}")
    if not found.is_sorted:
        parts.sort(key=itemgetter(0))
    head.text = "\n"
    start, _, end = ElementTree.tostring(head, encoding="unicode").rpartition("</")
    with copy.open("w", encoding="utf-8") as written:
        written.write(start)
        written.writelines(f"{text}\n" for _, text in parts)
        written.write(f"</{end}\n")
    return found


def _without_files(element: ElementTree.Element, found: Copied) -> bool:
    """Take what names files out of an element; return whether anything is left of it."""
    element.tag = tag = element.tag.rpartition("}")[2]
    if tag == "param":
        key, value = element.get("key", ""), element.get("value", "")
        if key.startswith("device.fcd-replay.file"):
            found.read(key, value)
        if _FILE.search(key) or _MEASURES.match(key) or _ELSEWHERE.match(value):
            found.outputs[f"parameter {key}"] += 1
            return False
    for name, value in list(element.attrib.items()):
        if not (name.startswith("{") or _FILE.search(name)):
            continue
        del element.attrib[name]
        if tag in READ_BY and name in ("file", "href"):
            found.read(f"<{tag}>", value)
        elif name in ("file", "dest", "output"):
            found.outputs[tag] += 1
            if name != "output":  # SUMO asks for the others
                element.set(name, "NUL")
    for child in list(element):
        if not _without_files(child, found):
            element.remove(child)
    return True


def _apart(
    element: ElementTree.Element, begin: float | None
) -> Iterator[tuple[ElementTree.Element, ElementTree.Element, float | None]]:
    """Yield an element twice, and the begin of flows that have none.

    Of an interval, which has this begin for its flows, they are those with one of its elements
    each, and this element.
    """
    if element.tag != _INTERVAL:
        yield element, element, begin
        return
    for inner in element:
        part = ElementTree.Element(_INTERVAL, element.attrib)
        part.append(inner)
        yield part, inner, _departure(element, begin)


def _departure(element: ElementTree.Element, begin: float | None) -> float | None:
    """Return when a vehicle, a person or a flow departs [s]; None if an event starts it."""
    given = element.get(_DEPARTURES[element.tag])
    if given is None:
        return begin
    try:
        return clock(given)
    except ValueError:
        return None


def clock(text: str) -> float:
    """Return a time of SUMO in seconds: a number, or ``[days:]hours:minutes:seconds``.

    Raises:
        ValueError: It is neither.
    """
    *parts, rest = (float(part) for part in text.split(":"))
    weights: dict[int, tuple[float, ...]] = {0: (), 2: (3600.0, 60.0), 3: (86400.0, 3600.0, 60.0)}
    if len(parts) not in weights:
        raise ValueError(f"must be seconds or hh:mm:ss, got {shown(text)}")
    return sum(w * part for w, part in zip(weights[len(parts)], parts, strict=True)) + rest
