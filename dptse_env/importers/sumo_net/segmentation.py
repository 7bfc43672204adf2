"""Segmentation of a path: its segments, its ramps, and the stretches of edges of each."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from dptse_env.geometry import Geometry
from dptse_env.importers.sumo_net.configuration import Files
from dptse_env.importers.sumo_net.net import (
    VEHICLE_CLASS,
    Net,
    connections,
    n_lanes,
    predecessors,
    successors,
)
from dptse_env.model.parameters import load_parameters
from dptse_env.traffic.own_sumo import TOLERANCE, Stretch
from dptse_env.utils.units import KMH
from dptse_env.utils.validation import require, shown

PARAMETERS = "w99-3lane"
"""Shipped parameters that allow the shortest segments."""

SHORTEST = 1000.0 * load_parameters(PARAMETERS).shortest_segment(1.0)
"""Shortest segment [m], on the mainline and on ramps: an environment has steps of a second."""

LONGEST = 1e6
"""Longest lane [m]."""

SECONDS_ON_SEGMENT = 1.2
"""Least time of a free crossing of a segment [s]: the traffic model's step is one second."""


@dataclass(frozen=True)
class Segmentation:
    """Segments of a road, and their stretches of edges in the net.

    Attributes:
        geometry: the segments, with exit shares of a half. The boundary segment of a ramp is as
            long as its segment.
        columns: stretches of each record column.
        names: edges of each ramp at the path, on-ramps first.
        remarks: sentences for people on what is unusual.
    """

    geometry: Geometry
    columns: tuple[tuple[Stretch, ...], ...]
    names: tuple[str, ...]
    remarks: tuple[str, ...]


def segment_path(
    files: Files,
    path: Sequence[str],
    segment_length: float,
    between: bool = False,
    left_out: Collection[str] = (),
    ends: tuple[float, float | None] = (0.0, None),
) -> Segmentation:
    """Cut a path of a net into segments, and find its ramps.

    The path is cut at every junction with a ramp, and between two of them into equal parts that are
    as near to the wanted length as possible. The first and the last part of the path are the
    boundary segments. A ramp is as long as wanted, or half as long as its road where that is
    shorter; the boundary segment behind it has the same length. Lanes that appear and end, such as
    acceleration lanes, count as lanes of the mainline: a segment has the mean number of lanes over
    its length, rounded.

    Args:
        files: what the simulation reads; of these only the net is read here.
        path: ids of the path's edges, or of its first and last with `between`.
        segment_length: wanted length of a segment [m].
        between: take the shortest path between the two edges of `path`.
        left_out: edges at the path that are no ramps; their vehicles appear and vanish.
        ends: positions [m] on the first edge, where the road begins, and on the last, where it
            ends; None for the end of that edge.

    Raises:
        ValueError: The net or the path is malformed, a position is not on its edge, the path is
            too short, or ramps are too near to one another or to its ends; the message names the
            file or the field.
    """
    allowed = f"at least {SHORTEST:g} m"
    require(segment_length >= SHORTEST, "segment_length", allowed, segment_length)
    require(len(path) >= 1, "path", "at least one edge", list(path))
    net = Net(files.net, files.internal_links)
    edges = net.path_between(path[0], path[-1]) if between else net.path_along(path)
    chain = Chain(net, edges)
    road = _limits(chain, ends)
    ramps, merged = _merged(_find_ramps(net, edges, left_out, 2.0 * segment_length), chain)
    cuts = _cuts(chain, road, ramps, segment_length)
    ramps.sort(key=lambda ramp: not ramp.joins)
    faces = [_face(cuts, chain.ends[ramp.junction]) for ramp in ramps]
    lengths = [min(segment_length, 0.5 * ramp.usable) for ramp in ramps]
    parts = list(pairwise(cuts[1:-1]))
    lanes = tuple(chain.lanes(start, end) for start, end in parts)
    sides = list(zip(ramps, faces, lengths, strict=True))
    if left_out:
        merged.append(f"left out: {', '.join(left_out)}; vehicles that take them appear and vanish")
    try:
        geometry = Geometry(
            n_mainline=len(parts),
            on_ramps=tuple(face for ramp, face, _ in sides if ramp.joins),
            off_ramps=tuple(face for ramp, face, _ in sides if not ramp.joins),
            exit_shares=(0.5,) * sum(not ramp.joins for ramp in ramps),
            lanes=lanes,
            ramp_lanes=tuple(
                min(ramp.lanes(length), lanes[face - (not ramp.joins)])
                for ramp, face, length in sides
            )
            or 1,
            segment_length=tuple(_kilometres(end - start) for start, end in parts),
            speed_limit=tuple(round(chain.limit(start, end), 1) for start, end in parts),
            ramp_length=tuple(map(_kilometres, lengths)) or None,
            ramp_speed_limit=tuple(round(ramp.limit(length), 1) for ramp, _, length in sides)
            or None,
        )
    except ValueError as problem:
        raise ValueError(f"net: {files.net}: {problem}") from problem
    return Segmentation(
        geometry,
        _columns(chain, cuts, sides),
        tuple(" + ".join(ramp.names) for ramp in ramps),
        (*net.remarks(edges), *merged),
    )


def _kilometres(length: float) -> float:
    return round(length / 1000.0, 4)


# Distances along edges ------------------------------------------------------------------------


@dataclass(frozen=True)
class _PlacedEdge:
    """An edge, or one of the internal edges of a crossing, at a distance along a chain.

    Attributes:
        edge: its id.
        start: distance of its start [m].
        end: distance of its end [m].
        length: its longest lane [m], which may differ from ``end - start`` on a crossing.
    """

    edge: str
    start: float
    end: float
    length: float

    def stretch(self, start: float, end: float) -> Stretch | None:
        """Return what lies between two distances; None for less than the precision."""
        scale = self.length / max(self.end - self.start, 1e-9)
        low, high = (
            float(np.clip((place - self.start) * scale, 0.0, self.length)) for place in (start, end)
        )
        return (self.edge, round(low, 3), round(high, 3)) if high - low > TOLERANCE else None


class Chain:
    """A sequence of connected edges and the crossings between them, with distances along it.

    The crossing of a junction, its internal edges, follows the edge before it. Where there are
    several ways over a junction, they lie side by side over the mean of their lengths.

    Args:
        net: the net.
        edges: the edges, in the direction of travel.
        onto: an edge that follows them; the crossing to it then belongs to the chain.

    Attributes:
        edges: the edges.
        ends: distance at which each edge ends, its crossing included [m].

    Raises:
        ValueError: The length or the speed limit of a lane is impossible.
    """

    def __init__(self, net: Net, edges: Sequence[Any], onto: Any = None) -> None:
        """Measure the edges."""
        self.edges, self.ends = list(edges), [0.0]
        self._parts: list[_PlacedEdge] = []
        for edge, after in zip(edges, [*edges[1:], onto], strict=True):
            end = self._add(net, edge, self.ends[-1], edge.getLength())
            ways = net.crossing(edge, after) if after is not None else []
            lengths = [sum(part.getLength() for part in way) for way in ways]
            mean = float(np.mean(lengths)) if ways else 0.0
            for way, length in zip(ways, lengths, strict=True):
                place = end
                for part in way:
                    share = part.getLength() * mean / max(length, 1e-9)
                    place = self._add(net, part, place, share)
            self.ends.append(end + mean)
        self._starts = self.ends[:-1]
        del self.ends[0]

    def _add(self, net: Net, edge: Any, start: float, length: float) -> float:
        """Add an edge that takes up a length [m] from a distance on; return where it ends."""
        for lane in edge.getLanes():
            speed = lane.getSpeed() if lane.allows(VEHICLE_CLASS) else 1.0
            if not (0.0 < lane.getLength() <= LONGEST and 0.0 < speed < np.inf):
                allowed = f"a length in (0, {LONGEST:g}] m and a finite speed above 0"
                found = f"{lane.getLength()} m and {lane.getSpeed()} m/s"
                name = lane.getID()
                raise ValueError(
                    f"net: {net.path}: lane {shown(name)} must have {allowed}, got {found}"
                )
        longest = max(float(lane.getLength()) for lane in edge.getLanes())
        self._parts.append(_PlacedEdge(edge.getID(), start, start + length, longest))
        return start + length

    @property
    def length(self) -> float:
        """Length of the chain [m]."""
        return self.ends[-1]

    def stretches(self, start: float, end: float) -> tuple[Stretch, ...]:
        """Return the stretches of edges between two distances [m]."""
        found = (part.stretch(start, end) for part in self._parts)
        return tuple(stretch for stretch in found if stretch is not None)

    def lanes(self, start: float, end: float) -> int:
        """Return the mean number of lanes between two distances [m], rounded."""
        total = sum(n_lanes(edge) * share for edge, share in self._shares(start, end))
        return max(1, int(total + 0.5))

    def limit(self, start: float, end: float) -> float:
        """Return the speed limit between two distances [m]: the speed of a free crossing [km/h]."""
        return KMH / sum(share / _limit(edge) for edge, share in self._shares(start, end))

    def shortest(self, start: float, end: float) -> float:
        """Return the least length of segments between two distances [m]."""
        return max(SHORTEST, SECONDS_ON_SEGMENT * self.limit(start, end) / KMH)

    def _shares(self, start: float, end: float) -> Iterator[tuple[Any, float]]:
        for edge, low, high in zip(self.edges, self._starts, self.ends, strict=True):
            shared = min(end, high) - max(start, low)
            if shared > 0.0:
                yield edge, shared / (end - start)


def _limit(edge: Any) -> float:
    """Return the highest limit of an edge's lanes for cars [m/s]."""
    return max(float(lane.getSpeed()) for lane in edge.getLanes() if lane.allows(VEHICLE_CLASS))


# Ramps ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _SideRoad:
    """A road that joins or leaves a path at a junction, as far as it is recorded.

    Attributes:
        chain: its edges, in the direction of travel.
        usable: length of the chain that belongs to this ramp [m]; an on-ramp has the last part of
            the chain, an off-ramp the first.
        joins: whether it joins the path.
    """

    chain: Chain
    usable: float
    joins: bool

    def range(self, near: float, far: float) -> tuple[float, float]:
        """Return distances along the chain for distances from the path [m]."""
        length = self.chain.length
        return (length - far, length - near) if self.joins else (near, far)


@dataclass
class Ramp:
    """A ramp at a face of the mainline; several branches that meet there are one ramp.

    Attributes:
        junction: index of the path's edge before the junction.
        joins: whether it is an on-ramp.
        names: ids of the edges at the path.
        branches: the roads.
        exits: internal edges on which vehicles that leave cross the junction.
    """

    junction: int
    joins: bool
    names: list[str] = field(default_factory=list)
    branches: list[_SideRoad] = field(default_factory=list)
    exits: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """Return its kind and its edges."""
        return f"{'on' if self.joins else 'off'}-ramp {'+'.join(self.names)}"

    def lanes(self, length: float) -> int:
        """Return the number of lanes of all branches together, over a length from the path [m]."""
        return sum(branch.chain.lanes(*branch.range(0.0, length)) for branch in self.branches)

    def limit(self, length: float) -> float:
        """Return the highest speed limit of the branches, over a length from the path, in km/h."""
        return max(branch.chain.limit(*branch.range(0.0, length)) for branch in self.branches)

    def stretches(self, near: float, far: float) -> list[Stretch]:
        """Return the stretches of all branches between two distances from the path [m]."""
        found = (branch.chain.stretches(*branch.range(near, far)) for branch in self.branches)
        return [stretch for of_branch in found for stretch in of_branch]

    @property
    def usable(self) -> float:
        """Length that all branches have [m]."""
        return min(branch.usable for branch in self.branches)


def _find_ramps(net: Net, path: list[Any], left_out: Collection[str], wanted: float) -> list[Ramp]:
    """Return the ramps of a path, in the order of their junctions, on-ramps first.

    A branch goes on along the only edge that follows. Where its road forks, it ends if it is at
    least half as long as wanted; else it goes on along the edge with the most lanes.

    Args:
        net: the net.
        path: edges of the path.
        left_out: edges at the path that are no ramps.
        wanted: length of a branch [m]: the ramp's segment and the boundary segment behind it.

    Raises:
        ValueError: An edge to leave out does not touch the path.
    """
    mouths: list[tuple[int, bool, Any]] = []
    on_path = set(path)
    for i, (edge, following) in enumerate(pairwise(path)):
        mouths += [(i, True, each) for each in predecessors(following) if each not in on_path]
        mouths += [(i, False, each) for each in successors(edge) if each not in on_path]
    names = {edge.getID() for _, _, edge in mouths}
    for name in left_out:
        if name not in names:
            raise ValueError(
                f"leave_out: {shown(name)} must be an edge that joins or leaves the path, one of "
                f"{', '.join(sorted(names)) or 'none'}"
            )
    mouths = [mouth for mouth in mouths if mouth[2].getID() not in left_out]
    taken = on_path | {edge for _, _, edge in mouths}
    sides = {(joins, edge) for _, joins, edge in mouths}
    ramps: dict[tuple[int, bool], Ramp] = {}
    for junction, joins, edge in mouths:
        ramp = ramps.setdefault((junction, joins), Ramp(junction, joins))
        edges = _walk(edge, joins, taken, wanted)
        taken |= set(edges)
        onto = path[junction + 1] if joins else None
        chain = Chain(net, edges[::-1] if joins else edges, onto)
        # A lay-by leaves the path and joins it again: each of its two ramps has a half.
        shared = (not joins, edge) in sides
        ramp.names.append(edge.getID())
        ramp.branches.append(_SideRoad(chain, chain.length * (0.5 if shared else 1.0), joins))
        if not joins:
            ways = net.crossing(path[junction], edge)
            ramp.exits += [part.getID() for way in ways for part in way]
    return list(ramps.values())


def _walk(edge: Any, joins: bool, taken: Collection[Any], wanted: float) -> list[Any]:
    """Return the edges of a branch, from the path outwards."""

    def width(each: Any) -> tuple[int, float]:
        """Return the number of lane connections between an edge and the last one; its length."""
        ways = connections(each, edges[-1]) if joins else connections(edges[-1], each)
        return len(ways), each.getLength()

    edges, length = [edge], edge.getLength()
    while length < wanted:
        onward = predecessors(edges[-1]) if joins else successors(edges[-1])
        free = [each for each in onward if each not in taken and each not in edges]
        if not free or (len(onward) > 1 and length >= 0.5 * wanted):
            break
        edges.append(max(free, key=width))
        length += edges[-1].getLength()
    return edges


def _merged(ramps: list[Ramp], chain: Chain) -> tuple[list[Ramp], list[str]]:
    """Make one ramp of those of a kind that are too near for a segment between them.

    Raises:
        ValueError: An on-ramp and an off-ramp are too near, or a ramp is too short; the message
            names all of them.
    """
    kept: list[Ramp] = []
    remarks: list[str] = []
    problems: list[str] = []
    dropped: list[str] = []
    for ramp in ramps:
        last = kept[-1] if kept else None
        place = chain.ends[ramp.junction]
        apart = place - chain.ends[last.junction] if last else np.inf
        if ramp.usable < 2 * SHORTEST:
            problems.append(
                f"{ramp} has {ramp.usable:.1f} m of the {2 * SHORTEST:g} m for a segment and a "
                "boundary segment"
            )
            dropped += ramp.names
        elif last is None or apart >= chain.shortest(
            max(place - 1.0, 0.0), min(place + 1.0, chain.length)
        ):
            kept.append(ramp)
        elif last.joins is not ramp.joins:
            problems.append(f"{last} and {ramp} are {apart:.0f} m apart")
            dropped += ramp.names
        else:
            last.names += ramp.names
            last.branches += ramp.branches
            last.exits += ramp.exits
            remarks.append(f"one ramp: {last}, {apart:.0f} m apart")
    if problems:
        raise ValueError(
            f"path: must have room for every ramp and for a segment between an on-ramp and an "
            f"off-ramp, got: {'; '.join(problems)}; leave out some of them, for instance "
            f'--leave-out="{" ".join(dropped)}"'
        )
    return kept, remarks


# Segments -------------------------------------------------------------------------------------


def _limits(chain: Chain, ends: tuple[float, float | None]) -> tuple[float, float]:
    """Return the distances at which a road begins and ends along a path [m]."""
    last = chain.edges[-1].getLength()
    places = []
    for where, edge, position in (
        ("first_position", chain.edges[0], ends[0]),
        ("last_position", chain.edges[-1], last if ends[1] is None else ends[1]),
    ):
        allowed = f"in [0, {edge.getLength():.1f}] m, the length of {shown(edge.getID())}"
        require(0.0 <= position <= edge.getLength(), where, allowed, position)
        places.append(float(position))
    return places[0], chain.length - last + places[1]


def _cuts(
    chain: Chain, limits: tuple[float, float], ramps: list[Ramp], wanted: float
) -> list[float]:
    """Return the distances of all faces along a path, the road's ends included [m]."""
    junctions = sorted({ramp.junction for ramp in ramps})
    places = [limits[0], *(chain.ends[junction] for junction in junctions), limits[1]]
    cuts = [limits[0]]
    for i, (start, end) in enumerate(pairwise(places)):
        # The first and the last stretch also have a boundary segment; a road has two segments.
        least = 1 + (i == 0) + (i == len(places) - 2) + (len(places) == 2)
        n_parts = max(least, round((end - start) / wanted))
        shortest = chain.shortest(start, end) if end > start else SHORTEST
        if (end - start) / n_parts < shortest:
            n_parts = int((end - start) / shortest)
        if n_parts < least:
            names = [
                " and ".join(str(ramp) for ramp in ramps if chain.ends[ramp.junction] == place)
                for place in (start, end)
            ]
            raise ValueError(
                f"path: must have {least * shortest:.1f} m from {names[0] or 'its start'} to "
                f"{names[1] or 'its end'} for its segments at this speed limit, got "
                f"{end - start:.1f} m: lengthen the path, or leave a ramp out (--leave-out)"
            )
        cuts += np.linspace(start, end, n_parts + 1)[1:].tolist()
    return cuts


def _face(cuts: list[float], place: float) -> int:
    """Return the number of the face at a distance; face 0 ends the upstream boundary segment."""
    return int(np.argmin(np.abs(np.array(cuts) - place))) - 1


def _columns(
    chain: Chain, cuts: list[float], sides: list[tuple[Ramp, int, float]]
) -> tuple[tuple[Stretch, ...], ...]:
    """Return the stretches of each record column: S segments, then R boundary segments."""
    parts = [list(chain.stretches(start, end)) for start, end in pairwise(cuts)]
    for ramp, face, _ in sides:
        # Who leaves is on the mainline until the junction is crossed.
        parts[face] += [(name, 0.0, 1e5) for name in ramp.exits]
    upstream, *mainline, downstream = parts
    near = [ramp.stretches(0.0, length) for ramp, _, length in sides]
    far = [ramp.stretches(length, 2.0 * length) for ramp, _, length in sides]
    return tuple(map(tuple, [*mainline, *near, upstream, downstream, *far]))
