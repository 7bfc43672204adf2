"""SUMO nets, as `sumolib` reads them: edges that are open to cars, and paths along them."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax import SAXException

from dptse_env.traffic.own_sumo import UNREADABLE
from dptse_env.utils.files import open_unzipped
from dptse_env.utils.validation import shown

NEWEST_VERSION = (1, 20)
"""Newest version of net files that the supported release of SUMO reads."""

VEHICLE_CLASS = "passenger"
"""Lanes that this class may not use (bus lanes, hard shoulders, pavements) do not count."""

# `sumolib` checks no element: one that is missing or malformed becomes one of these.
_BROKEN = (*UNREADABLE, OSError, SAXException, AttributeError, TypeError)


class Net:
    """A SUMO net.

    Args:
        path: the net file, plain or gzipped.
        internal_links: whether vehicles drive on the internal edges of junctions; False for a
            simulation with ``--no-internal-links``.

    Attributes:
        path: the net file.
        edges: edges by id, without internal ones.

    Raises:
        ValueError: There is no such file, or it is no network that SUMO reads.
    """

    def __init__(self, path: Path, internal_links: bool = True) -> None:
        """Read the file."""
        from sumolib.net import readNet  # noqa: PLC0415  (slow to import)

        root = root_of(path, "net")
        if root.tag != "net":
            raise ValueError(f"net: {path} must be a SUMO net (<net>), got <{root.tag:.60}>")
        _check_version(path, root.get("version", ""))
        try:
            self._net: Any = readNet(str(path), withInternal=internal_links)
            edges = self._net.getEdges(withInternal=False)
        except _BROKEN as error:
            problem = f"{type(error).__name__}: {error}"[:200]
            raise ValueError(f"net: {path} must be a SUMO net, got {problem}") from error
        self.path, self._internal_links = path, internal_links
        self.edges: dict[str, Any] = {edge.getID(): edge for edge in edges}
        if not self.edges:
            raise ValueError(f"net: {path} must have edges, got a net without any")

    def edge(self, name: str, where: str) -> Any:
        """Return an edge.

        Raises:
            ValueError: There is none of this name, or it is closed to cars.
        """
        if name not in self.edges:
            near = difflib.get_close_matches(name, self.edges, n=3)
            hint = f"; similar: {', '.join(near)}" if near else ""
            raise ValueError(f"{where}: {self.path} has no edge {shown(name)}{hint}")
        if not self.edges[name].allows(VEHICLE_CLASS):
            raise ValueError(f"{where}: edge {shown(name)} must be open to cars, got a closed one")
        return self.edges[name]

    def path_along(self, names: Sequence[str]) -> list[Any]:
        """Return the edges of a path that is given edge by edge.

        Raises:
            ValueError: An edge is unknown, closed to cars, there twice, or not connected to the
                next.
        """
        path = [self.edge(name, "path") for name in names]
        for place, name in enumerate(names):
            if name in names[:place]:
                raise ValueError(f"path: must not be a loop, got edge {shown(name)} twice")
        for edge, following in pairwise(path):
            if not connections(edge, following):
                onward = ", ".join(each.getID() for each in successors(edge)) or "none"
                raise ValueError(
                    f"path: edge {shown(edge.getID())} must be connected to "
                    f"{shown(following.getID())}, got connections to {onward}"
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
            raise ValueError(
                f"last: edge {shown(last)} must be reachable from {shown(first)}, and is not"
            )
        return self.path_along([edge.getID() for edge in path])

    def crossing(self, edge: Any, following: Any) -> list[list[Any]]:
        """Return the ways over the junction between two edges, each a list of internal edges.

        Raises:
            ValueError: A way leads nowhere, or round in a circle.
        """
        taken: set[str] = set()  # edges that a way shares with another belong to the first
        ways = []
        for connection in connections(edge, following) if self._internal_links else ():
            ways.append([each for each in self._way(connection) if each.getID() not in taken])
            taken.update(each.getID() for each in ways[-1])
        return [way for way in ways if way]

    def _way(self, connection: Any) -> list[Any]:
        """Return the internal edges of a connection, in the direction of travel."""
        way: list[Any] = []
        while via := connection.getViaLaneID():
            where = f"net: {self.path}: lane {shown(via)} must lead over its junction"
            try:
                lane = self._net.getLane(via)
                connection = lane.getOutgoing()[0]
            except (LookupError, ValueError) as error:
                raise ValueError(f"{where}, got an end") from error
            if lane.getEdge() in way:
                raise ValueError(f"{where}, got a circle")
            way.append(lane.getEdge())
        return way

    def remarks(self, path: Sequence[Any]) -> Iterator[str]:
        """Yield sentences for people on traffic lights and roundabouts on a path."""
        for edge in path[:-1]:
            junction = edge.getToNode()
            if junction and "traffic_light" in (junction.getType() or ""):
                yield f"traffic light at junction {junction.getID()!r}, after {edge.getID()!r}"
        names = {edge.getID() for edge in path}
        for roundabout in self._net.getRoundabouts():
            if shared := sorted(names & set(roundabout.getEdges())):
                yield f"roundabout: edge(s) {', '.join(shared)}"


def connections(edge: Any, following: Any) -> list[Any]:
    """Return the connections for cars from one edge to another, without turning round."""
    allowed = edge.getAllowedOutgoing(VEHICLE_CLASS).get(following, ())
    return [connection for connection in allowed if connection.getDirection() != "t"]


def successors(edge: Any) -> list[Any]:
    """Return the edges to which cars can go on, by id."""
    onward = (each for each in edge.getOutgoing() if not each.isSpecial())
    return sorted((each for each in onward if connections(edge, each)), key=_name)


def predecessors(edge: Any) -> list[Any]:
    """Return the edges from which cars can come, by id."""
    before = (each for each in edge.getIncoming() if not each.isSpecial())
    return sorted((each for each in before if connections(each, edge)), key=_name)


def n_lanes(edge: Any) -> int:
    """Return the number of an edge's lanes that are open to cars."""
    return sum(lane.allows(VEHICLE_CLASS) for lane in edge.getLanes())


def root_of(path: Path, where: str) -> ElementTree.Element:
    """Return the root element of an XML file, with its attributes alone.

    Raises:
        ValueError: There is no such file, or it is no XML; the message names `where` and the path.
    """
    if path.is_dir():
        raise ValueError(f"{where}: {path} must be a file, got a folder")
    try:
        with open_unzipped(path) as file:
            root: ElementTree.Element = next(ElementTree.iterparse(file, events=("start",)))[1]
            return root
    except UNREADABLE as error:
        raise ValueError(
            f"{where}: {path} must be XML, got something else (binary, encrypted or damaged): "
            f"{error!s:.200}"
        ) from error
    except OSError as error:
        raise ValueError(f"{where}: {path} cannot be read: {error.strerror}") from error


def _check_version(path: Path, version: str) -> None:
    """Check that a net is of a version that can be read."""
    try:
        numbers = tuple(int(part) for part in version.split(".")[:2])
    except ValueError as error:
        raise ValueError(f"net: {path}: version must be numbers, got {shown(version)}") from error
    if numbers > NEWEST_VERSION:
        newest = ".".join(map(str, NEWEST_VERSION))
        raise ValueError(
            f"net: {path}: version must be at most {newest}, got {version:.20}; write it with the "
            "netconvert of the supported release"
        )


def _name(edge: Any) -> str:
    name: str = edge.getID()
    return name
