"""Edges one after another, with distances along them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dptse_env.traffic.sumo_import.net import VEHICLE_CLASS, Net, n_lanes
from dptse_env.traffic.sumo_scenario import TOLERANCE, Stretch


@dataclass(frozen=True)
class _Part:
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
    """A sequence of connected edges and the crossings between them.

    The crossing of a junction, its internal edges, follows the edge before it. Where there are
    several ways over a junction, they lie side by side over the mean of their lengths.

    Args:
        net: the network.
        edges: the edges, in the direction of travel.
        onto: an edge that follows them; the crossing to it then belongs to the chain.

    Attributes:
        edges: the edges.
        ends: distance at which each edge ends, its crossing included [m].
    """

    def __init__(self, net: Net, edges: Sequence[Any], onto: Any = None) -> None:
        """Measure the edges."""
        self.edges = list(edges)
        self._parts: list[_Part] = []
        self._ranges: list[tuple[float, float]] = []
        self.ends: list[float] = []
        following = [*edges[1:], onto]
        place = 0.0
        for edge, after in zip(edges, following, strict=True):
            end = place + edge.getLength()
            self._parts.append(_Part(edge.getID(), place, end, _longest(edge)))
            if after is not None:
                end = self._cross(net.crossing(edge, after), end)
            self._ranges.append((place, end))
            self.ends.append(end)
            place = end

    def _cross(self, ways: list[list[Any]], start: float) -> float:
        """Lay the ways over a junction side by side; return the distance of their end."""
        if not ways:
            return start
        lengths = [sum(part.getLength() for part in way) for way in ways]
        mean = float(np.mean(lengths))
        for way, length in zip(ways, lengths, strict=True):
            place = start
            for part in way:
                end = place + part.getLength() * mean / max(length, 1e-9)
                self._parts.append(_Part(part.getID(), place, end, _longest(part)))
                place = end
        return start + mean

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
        return 3.6 / sum(share / _limit(edge) for edge, share in self._shares(start, end))

    def _shares(self, start: float, end: float) -> Iterator[tuple[Any, float]]:
        for edge, (low, high) in zip(self.edges, self._ranges, strict=True):
            shared = min(end, high) - max(start, low)
            if shared > 0.0:
                yield edge, shared / (end - start)


def _longest(edge: Any) -> float:
    return max(float(lane.getLength()) for lane in edge.getLanes())


def _limit(edge: Any) -> float:
    """Return the highest limit of an edge's lanes for cars [m/s]."""
    return max(float(lane.getSpeed()) for lane in edge.getLanes() if lane.allows(VEHICLE_CLASS))
