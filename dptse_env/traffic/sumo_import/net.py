"""Networks of SUMO: reading one, and a path along it."""

from __future__ import annotations

import difflib
import gzip
import xml.sax
import zlib
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

NEWEST_VERSION = (1, 20)
"""Newest version of network files that the supported release of SUMO reads."""

VEHICLE_CLASS = "passenger"
"""Lanes that this class may not use (bus lanes, hard shoulders, pavements) do not count."""

GZIP_MAGIC = b"\x1f\x8b"


_UNREADABLE = (
    SyntaxError,
    xml.sax.SAXException,
    LookupError,
    ValueError,
    EOFError,
    OSError,
    zlib.error,
)


class Net:
    """A network of SUMO, as `sumolib` reads it.

    Args:
        path: the network file, plain or gzipped.
        internal_links: whether vehicles drive on the internal edges of junctions; False for a
            simulation with ``--no-internal-links``.

    Raises:
        ValueError: There is no such file, or it is no network that SUMO reads.
    """

    def __init__(self, path: Path, internal_links: bool = True) -> None:
        """Read the file."""
        import sumolib  # noqa: PLC0415  (heavy, and only an import needs it)

        self.path = path
        _check_head(path)
        try:
            self._net: Any = sumolib.net.readNet(str(path), withInternal=internal_links)
        except _UNREADABLE as error:
            raise ValueError(f"net: {path}: no network of SUMO: {error}") from error
        self._internal_links = internal_links
        self.edges: dict[str, Any] = {
            edge.getID(): edge for edge in self._net.getEdges(withInternal=False)
        }
        if not self.edges:
            raise ValueError(f"net: {path}: must have edges, got a network without any")

    def edge(self, name: str, where: str) -> Any:
        """Return an edge.

        Raises:
            ValueError: There is none of this name, or it is closed to cars.
        """
        if name not in self.edges:
            near = difflib.get_close_matches(name, self.edges, n=3)
            hint = f"; similar: {', '.join(near)}" if near else ""
            raise ValueError(f"{where}: {self.path} has no edge {name!r}{hint}")
        edge = self.edges[name]
        if not edge.allows(VEHICLE_CLASS):
            raise ValueError(f"{where}: edge {name!r} must be open to cars, got a closed one")
        return edge

    def path_along(self, names: Sequence[str]) -> list[Any]:
        """Return the edges of a path that is given edge by edge.

        Raises:
            ValueError: An edge is unknown, closed to cars, there twice, or not connected to the
                next.
        """
        path = [self.edge(name, "path") for name in names]
        seen: set[str] = set()
        for name in names:
            if name in seen:
                raise ValueError(f"path: must not be a loop, got edge {name!r} twice")
            seen.add(name)
        for edge, following in pairwise(path):
            if not connections(edge, following):
                onward = ", ".join(each.getID() for each in successors(edge)) or "none"
                raise ValueError(
                    f"path: edge {edge.getID()!r} must be connected to {following.getID()!r}, got "
                    f"connections to {onward}"
                )
        return path

    def path_between(self, first: str, last: str) -> list[Any]:
        """Return the shortest path for cars from one edge to another.

        Raises:
            ValueError: An edge is unknown or closed to cars, or there is no path.
        """
        ends = self.edge(first, "first"), self.edge(last, "last")
        path, _ = self._net.getShortestPath(*ends, vClass=VEHICLE_CLASS)
        if path is None:
            raise ValueError(f"last: edge {last!r} must be reachable from {first!r}, and is not")
        return self.path_along([edge.getID() for edge in path])

    def crossing(self, edge: Any, following: Any) -> list[list[Any]]:
        """Return the ways over the junction between two edges, each a list of internal edges."""
        ways: dict[str, list[Any]] = {}
        for connection in connections(edge, following):
            via = connection.getViaLaneID() if self._internal_links else ""
            if via:
                way, _ = self._net.getInternalPath([connection])
                ways.setdefault(" ".join(part.getID() for part in way), way)
        # Edges that a way shares with another belong to the first.
        taken: set[str] = set()
        found = []
        for way in ways.values():
            own = [part for part in way if part.getID() not in taken]
            taken.update(part.getID() for part in own)
            found.append(own)
        return [way for way in found if way]

    def remarks(self, path: Sequence[Any]) -> Iterator[str]:
        """Yield what is unusual of a path: traffic lights and roundabouts on it."""
        for edge in path[:-1]:
            junction = edge.getToNode()
            if "traffic_light" in junction.getType():
                yield f"traffic light at junction {junction.getID()!r}, after {edge.getID()!r}"
        names = {edge.getID() for edge in path}
        for roundabout in self._net.getRoundabouts():
            shared = sorted(names & set(roundabout.getEdges()))
            if shared:
                yield f"roundabout: edge(s) {', '.join(shared)}"


def connections(edge: Any, following: Any) -> list[Any]:
    """Return the connections for cars from one edge to another, without turning round."""
    return [
        connection
        for connection in edge.getOutgoing().get(following, ())
        if connection.getDirection() != "t"
        and connection.getFromLane().allows(VEHICLE_CLASS)
        and connection.getToLane().allows(VEHICLE_CLASS)
    ]


def successors(edge: Any) -> list[Any]:
    """Return the edges to which cars can go on, by id."""
    roads = [each for each in edge.getOutgoing() if not each.isSpecial()]
    found = [each for each in roads if connections(edge, each)]
    return sorted(found, key=lambda each: each.getID())


def predecessors(edge: Any) -> list[Any]:
    """Return the edges from which cars can come, by id."""
    roads = [each for each in edge.getIncoming() if not each.isSpecial()]
    found = [each for each in roads if connections(each, edge)]
    return sorted(found, key=lambda each: each.getID())


def n_lanes(edge: Any) -> int:
    """Return the number of an edge's lanes that are open to cars."""
    return sum(lane.allows(VEHICLE_CLASS) for lane in edge.getLanes())


def open_xml(path: Path) -> Any:
    """Open a file, plain or gzipped, for reading bytes."""
    with path.open("rb") as file:
        zipped = file.read(2) == GZIP_MAGIC
    return gzip.open(path) if zipped else path.open("rb")


def root_of(path: Path, where: str) -> ElementTree.Element:
    """Return the root element of an XML file, with its attributes alone.

    Raises:
        ValueError: There is no such file, or it is no XML; the message names `where` and the path.
    """
    if path.is_dir():
        raise ValueError(f"{where}: {path} must be a file, got a folder")
    try:
        with open_xml(path) as file:
            root: ElementTree.Element = next(ElementTree.iterparse(file, events=("start",)))[1]
            return root
    except (ElementTree.ParseError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise ValueError(
            f"{where}: {path} must be XML, got something else (binary, encrypted or damaged): "
            f"{error}"
        ) from error
    except OSError as error:
        raise ValueError(f"{where}: {path} cannot be read: {error.strerror}") from error


def _check_head(path: Path) -> None:
    """Check that a file is a network, and of a version that can be read."""
    root = root_of(path, "net")
    if root.tag != "net":
        raise ValueError(f"net: {path} must be a network (<net>), got <{root.tag}>")
    version = root.get("version", "")
    try:
        numbers = tuple(int(part) for part in version.split(".")[:2])
    except ValueError as error:
        raise ValueError(f"net: {path}: version must be numbers, got {version!r}") from error
    if numbers > NEWEST_VERSION:
        newest = ".".join(map(str, NEWEST_VERSION))
        raise ValueError(
            f"net: {path}: version must be at most {newest}, got {version}; write it with the "
            "netconvert of the supported release"
        )
