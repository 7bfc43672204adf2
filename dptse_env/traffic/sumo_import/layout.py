"""Segments of a path: where they are cut, and which stretches of edges belong to them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from dptse_env.traffic.sumo_import.chain import Chain
from dptse_env.traffic.sumo_import.net import Net
from dptse_env.traffic.sumo_import.ramps import Ramp, find_ramps
from dptse_env.traffic.sumo_scenario import Stretch
from dptse_env.utils.fields import require

SHORTEST = 40.0
"""Shortest segment [m]."""

SECONDS_ON_SEGMENT = 1.2
"""Least time of a free crossing of a segment [s]: the traffic model's step is one second."""


@dataclass(frozen=True)
class Layout:
    """The segments of a road, and where they are in the network.

    Attributes:
        lengths: (N,) length of each mainline segment [m].
        lanes: (N,) lanes of each mainline segment.
        limits: (N,) speed limit of each mainline segment [km/h].
        on_ramps: face of each on-ramp.
        off_ramps: face of each off-ramp.
        ramp_lengths: length of each ramp [m], on-ramps first; its boundary segment is as long.
        ramp_lanes: lanes of each ramp, on-ramps first, at most those of the segment that it joins
            or leaves.
        ramp_limits: speed limit of each ramp [km/h], on-ramps first.
        columns: stretches of each record column.
        names: what each ramp is in the network, on-ramps first.
        remarks: what was unusual, for people.
    """

    lengths: tuple[float, ...]
    lanes: tuple[int, ...]
    limits: tuple[float, ...]
    on_ramps: tuple[int, ...]
    off_ramps: tuple[int, ...]
    ramp_lengths: tuple[float, ...]
    ramp_lanes: tuple[int, ...]
    ramp_limits: tuple[float, ...]
    columns: tuple[tuple[Stretch, ...], ...]
    names: tuple[str, ...]
    remarks: tuple[str, ...]


def lay_out(
    net: Net,
    path: list[Any],
    segment_length: float,
    left_out: Collection[str] = (),
    ends: tuple[float, float | None] = (0.0, None),
) -> Layout:
    """Cut a path into segments, and find its ramps.

    The path is cut at every junction with a ramp, and between two of them into equal parts that are
    as near to the wanted length as possible. The first and the last part of the path are the
    boundary segments. A ramp is as long as wanted, or half as long as its road where that is
    shorter; the boundary segment behind it has the same length. Lanes that appear and end, such as
    acceleration lanes, count as lanes of the mainline: a segment has the mean number of lanes over
    its length, rounded.

    Args:
        net: the network.
        path: connected edges.
        segment_length: wanted length of a segment [m].
        left_out: edges at the path that are no ramps; their vehicles appear and vanish.
        ends: positions [m] on the first edge, where the road begins, and on the last edge, where it
            ends; None for the end of that edge.

    Raises:
        ValueError: A position is not on its edge, the path is too short, or ramps are too near to
            one another or to its ends.
    """
    chain = Chain(net, path)
    limits = _limits(chain, ends)
    ramps = find_ramps(net, path, left_out, 2.0 * segment_length)
    ramps, merged = _merged(ramps, chain)
    cuts = _cuts(chain, limits, ramps, segment_length)
    faces = {ramp.junction: _face(cuts, chain.ends[ramp.junction]) for ramp in ramps}
    ordered = [ramp for joins in (True, False) for ramp in ramps if ramp.joins is joins]
    lengths = [min(segment_length, 0.5 * ramp.usable) for ramp in ordered]
    parts = list(pairwise(cuts[1:-1]))
    lanes = tuple(chain.lanes(start, end) for start, end in parts)
    beside = [lanes[faces[ramp.junction] - (not ramp.joins)] for ramp in ordered]
    return Layout(
        lengths=tuple(end - start for start, end in parts),
        lanes=lanes,
        limits=tuple(chain.limit(start, end) for start, end in parts),
        on_ramps=tuple(faces[ramp.junction] for ramp in ordered if ramp.joins),
        off_ramps=tuple(faces[ramp.junction] for ramp in ordered if not ramp.joins),
        ramp_lengths=tuple(lengths),
        ramp_lanes=tuple(
            min(ramp.lanes(length), most)
            for ramp, length, most in zip(ordered, lengths, beside, strict=True)
        ),
        ramp_limits=tuple(
            ramp.limit(length) for ramp, length in zip(ordered, lengths, strict=True)
        ),
        columns=_columns(chain, cuts, ordered, lengths, faces),
        names=tuple(" + ".join(ramp.names) for ramp in ordered),
        remarks=(*net.remarks(path), *merged, *_left_out(left_out)),
    )


def _merged(ramps: list[Ramp], chain: Chain) -> tuple[list[Ramp], list[str]]:
    """Make one ramp of those of a kind that are too near for a segment between them.

    Raises:
        ValueError: An on-ramp and an off-ramp are too near, or a ramp is too short; the message
            names all of them.
    """
    kept: list[Ramp] = []
    remarks: list[str] = []
    problems: list[str] = []
    dropped: list[Ramp] = []
    for ramp in ramps:
        last = kept[-1] if kept else None
        apart = chain.ends[ramp.junction] - chain.ends[last.junction] if last else np.inf
        if ramp.usable < 2 * SHORTEST:
            problems.append(
                f"{ramp} has {ramp.usable:.0f} m of the {2 * SHORTEST:.0f} m for a segment and a "
                "boundary segment"
            )
            dropped.append(ramp)
        elif last is None or apart >= _shortest(chain, ramp.junction):
            kept.append(ramp)
        elif last.joins is not ramp.joins:
            problems.append(f"{last} and {ramp} are {apart:.0f} m apart")
            dropped.append(ramp)
        else:
            last.names += ramp.names
            last.branches += ramp.branches
            last.exits += ramp.exits
            remarks.append(f"one ramp: {last}, {apart:.0f} m apart")
    if problems:
        names = " ".join(name for ramp in dropped for name in ramp.names)
        raise ValueError(
            f"path: must have room for every ramp and for a segment between an on-ramp and an "
            f"off-ramp, got: {'; '.join(problems)}; leave out some of them, for instance "
            f'--leave-out="{names}"'
        )
    return kept, remarks


def _shortest(chain: Chain, index: int) -> float:
    """Return the least length of segments beside the end of an edge of a path [m]."""
    place = chain.ends[index]
    limit = chain.limit(max(place - 1.0, 0.0), min(place + 1.0, chain.length))
    return max(SHORTEST, SECONDS_ON_SEGMENT * limit / 3.6)


def _limits(chain: Chain, ends: tuple[float, float | None]) -> tuple[float, float]:
    """Return the distances at which a road begins and ends along a path [m]."""
    first, last = chain.edges[0], chain.edges[-1]
    start, end = _on_edge("first_position", ends[0], first), last.getLength()
    if ends[1] is not None:
        end = _on_edge("last_position", ends[1], last)
    return start, chain.length - last.getLength() + end


def _on_edge(where: str, position: float, edge: Any) -> float:
    """Return a position on an edge [m], or raise ``ValueError``."""
    allowed = f"in [0, {edge.getLength():.1f}] m, the length of {edge.getID()!r}"
    require(0.0 <= position <= edge.getLength(), where, allowed, position)
    return float(position)


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
        limit = chain.limit(start, end)
        shortest = max(SHORTEST, SECONDS_ON_SEGMENT * limit / 3.6)
        if (end - start) / n_parts < shortest:
            most = int((end - start) / shortest)
            if most < least:
                raise ValueError(_too_short(chain, ramps, start, end, least * shortest))
            n_parts = most
        cuts += np.linspace(start, end, n_parts + 1)[1:].tolist()
    return cuts


def _too_short(chain: Chain, ramps: list[Ramp], start: float, end: float, least: float) -> str:
    def place(distance: float) -> str:
        here = [ramp for ramp in ramps if chain.ends[ramp.junction] == distance]
        names = " and ".join(map(str, here))
        return names or ("its start" if distance == start else "its end")

    return (
        f"path: must have {least:.1f} m from {place(start)} to {place(end)} for its segments at "
        f"this speed limit, got {end - start:.1f} m: lengthen the path, or leave a ramp out "
        "(--leave-out)"
    )


def _face(cuts: list[float], place: float) -> int:
    """Return the number of the face at a distance; face 0 ends the upstream boundary segment."""
    return int(np.argmin(np.abs(np.array(cuts) - place))) - 1


def _columns(
    chain: Chain,
    cuts: list[float],
    ramps: list[Ramp],
    lengths: list[float],
    faces: dict[int, int],
) -> tuple[tuple[Stretch, ...], ...]:
    """Return the stretches of each record column: S segments, then R boundary segments."""
    parts = [list(chain.stretches(start, end)) for start, end in pairwise(cuts)]
    for ramp in ramps:
        # Who leaves is on the mainline until the junction is crossed.
        parts[faces[ramp.junction]] += [(name, 0.0, 1e5) for name in ramp.exits]
    upstream, *mainline, downstream = parts
    near = [_stretches(ramp, 0.0, length) for ramp, length in zip(ramps, lengths, strict=True)]
    far = [
        _stretches(ramp, length, 2.0 * length) for ramp, length in zip(ramps, lengths, strict=True)
    ]
    return tuple(map(tuple, [*mainline, *near, upstream, downstream, *far]))


def _stretches(ramp: Ramp, near: float, far: float) -> list[Stretch]:
    return [part for branch in ramp.branches for part in branch.stretches(near, far)]


def _left_out(names: Collection[str]) -> Iterator[str]:
    if names:
        yield f"left out: {', '.join(names)}; vehicles that take them appear and vanish"
