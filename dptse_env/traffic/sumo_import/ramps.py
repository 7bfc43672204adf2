"""Ramps of a path: the edges that join it and those that leave it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from dptse_env.traffic.sumo_import.chain import Chain
from dptse_env.traffic.sumo_import.net import Net, connections, predecessors, successors
from dptse_env.traffic.sumo_scenario import Stretch


@dataclass(frozen=True)
class Branch:
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

    def stretches(self, near: float, far: float) -> tuple[Stretch, ...]:
        """Return the stretches between two distances from the path [m]."""
        if self.joins:
            return self.chain.stretches(self.chain.length - far, self.chain.length - near)
        return self.chain.stretches(near, far)

    def lanes(self, far: float) -> int:
        """Return the number of lanes from the path to a distance from it [m]."""
        return self.chain.lanes(*self._range(far))

    def limit(self, far: float) -> float:
        """Return the speed limit from the path to a distance from it [m], in km/h."""
        return self.chain.limit(*self._range(far))

    def _range(self, far: float) -> tuple[float, float]:
        length = self.chain.length
        return (length - far, length) if self.joins else (0.0, far)


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
    branches: list[Branch] = field(default_factory=list)
    exits: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """Return its kind and its edges."""
        return f"{'on' if self.joins else 'off'}-ramp {'+'.join(self.names)}"

    def lanes(self, length: float) -> int:
        """Return the number of lanes of all branches together, over a length from the path [m]."""
        return sum(branch.lanes(length) for branch in self.branches)

    def limit(self, length: float) -> float:
        """Return the highest speed limit of the branches, over a length from the path, in km/h."""
        return max(branch.limit(length) for branch in self.branches)

    @property
    def usable(self) -> float:
        """Length that all branches have [m]."""
        return min(branch.usable for branch in self.branches)


def find_ramps(net: Net, path: list[Any], left_out: Collection[str], wanted: float) -> list[Ramp]:
    """Return the ramps of a path, in the order of their junctions, on-ramps first.

    A branch goes on along the only edge that follows. Where its road forks, it ends if it is at
    least half as long as wanted; else it goes on along the edge with the most lanes.

    Args:
        net: the network.
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
                f"leave_out: {name!r} must be an edge that joins or leaves the path, one of "
                f"{', '.join(sorted(names)) or 'none'}"
            )
    mouths = [mouth for mouth in mouths if mouth[2].getID() not in left_out]
    taken = on_path | {edge for _, _, edge in mouths}
    entering = {edge for _, joins, edge in mouths if joins}
    leaving = {edge for _, joins, edge in mouths if not joins}
    ramps: dict[tuple[int, bool], Ramp] = {}
    for junction, joins, edge in mouths:
        ramp = ramps.setdefault((junction, joins), Ramp(junction, joins))
        edges = _walk(edge, joins, taken, wanted)
        taken |= set(edges)
        onto = path[junction + 1] if joins else None
        chain = Chain(net, edges[::-1] if joins else edges, onto)
        # A lay-by leaves the path and joins it again: each of its two ramps has a half.
        shared = edge in entering and edge in leaving
        ramp.names.append(edge.getID())
        ramp.branches.append(Branch(chain, chain.length * (0.5 if shared else 1.0), joins))
        if not joins:
            ways = net.crossing(path[junction], edge)
            ramp.exits += [part.getID() for way in ways for part in way]
    return [ramps[key] for key in sorted(ramps, key=lambda key: (key[0], not key[1]))]


def _walk(edge: Any, joins: bool, taken: Collection[Any], wanted: float) -> list[Any]:
    """Return the edges of a branch, from the path outwards."""
    edges, length = [edge], edge.getLength()
    while length < wanted:
        onward = predecessors(edges[-1]) if joins else successors(edges[-1])
        free = [each for each in onward if each not in taken and each not in edges]
        if not free or (len(onward) > 1 and length >= 0.5 * wanted):
            break
        edge = max(free, key=lambda each: (_width(each, edges[-1], joins), each.getLength()))
        edges.append(edge)
        length += edge.getLength()
    return edges


def _width(edge: Any, neighbour: Any, joins: bool) -> int:
    """Return the number of lane connections between an edge of a branch and the next one."""
    return len(connections(edge, neighbour) if joins else connections(neighbour, edge))
