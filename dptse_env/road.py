"""The geometry of a road as arrays, made of a `Geometry` once, for all that computes on it.

Its cells are the S segments, in the order of `dptse_env.geometry`, then the R boundary
segments around them: upstream and downstream of the mainline, before each on-ramp, after each
off-ramp.

Traffic leaves a segment through one face: into one segment (LINK), into one that another segment
flows into as well (MERGE), into two segments (DIVERGE), or out of the road (EXIT).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from dptse_env.geometry import Geometry
from dptse_env.utils.arrays import FloatArray, IntArray

LINK, MERGE, DIVERGE, EXIT = 0, 1, 2, 3


class Road(NamedTuple):
    """A road of S segments and R boundary cells; nothing changes its arrays.

    E edges lead from segment to segment. There are I on-ramps and O off-ramps.
    """

    n_mainline: int  # n
    n_segments: int  # S
    lengths: FloatArray  # (S + R,) [km]
    lanes: FloatArray  # (S + R,)
    limits: FloatArray  # (S + R,) speed limits [km/h]
    beside: IntArray  # (R,) segment next to each boundary cell
    stretch: IntArray  # (S,) 0 on the mainline, then a number for each ramp, on-ramps first
    position: FloatArray  # (S,) [km] along the mainline: a segment's middle, or its ramp's face
    kind: IntArray  # (S,) LINK, MERGE, DIVERGE or EXIT: the face that a segment flows out through
    # (S, 3) the segment, the one it flows into, and the third one at a junction (the other
    # branch of a merge, the off-ramp of a diverge), -1 where there is none
    parties: IntArray
    share: FloatArray  # (S,) exit share of a diverge, 0 elsewhere
    edges: IntArray  # (E, 2) segments (from, to) between which vehicles pass
    edge_share: FloatArray  # (E,) share of the outflow that passes along each edge
    entries: IntArray  # (1 + I,) segments with inflow from outside: the first one, the on-ramps'
    entry_cells: IntArray  # (1 + I,) boundary cells before them
    entry_inputs: IntArray  # (1 + I,) the model's input of each demand; that of its w follows
    exits: IntArray  # (1 + O,) segments with outflow to outside: the mainline's last, off-ramps'
    exit_cells: IntArray  # (1 + O,) boundary cells after them
    exit_inputs: IntArray  # (1 + O,) the model's input of each density
    exit_of: IntArray  # (S,) which exit a segment is, -1 elsewhere
    # (S, K) segments that a segment's next state depends on, itself first, -1 padded
    neighbours: IntArray
    degree: IntArray  # (S,) how many there are
    # (T, 4) terms of a step's Jacobian, each an outflow's gradient in the rows of a segment that
    # it moves: that segment, the slot among its neighbours of the segment by which is derived, the
    # outflow's segment, and the place of the former among its parties
    terms: IntArray
    term_share: FloatArray  # (T,) -1 in the rows of the outflow's segment, else the edge's share

    @property
    def n_inputs(self) -> int:
        """Length of the model's input vector: 3 + 2 I + O."""
        return 2 * self.entries.size + self.exits.size

    def __deepcopy__(self, memo: object) -> Road:
        """Return the same arrays, which copies of an environment share."""
        return self


def make_road(geometry: Geometry) -> Road:
    """Return the arrays of a geometry."""
    n, on, off = geometry.n_mainline, geometry.on_ramp_segments, geometry.off_ramp_segments
    S, n_on, n_off = geometry.n_segments, len(on), len(off)
    around = (0, n - 1, *(segments[0] for segments in on), *(segments[-1] for segments in off))
    beside = np.array(around, dtype=np.int64)
    lengths, lanes, limits = (
        np.append(values, np.array(values)[beside]).astype(np.float64)
        for values in (geometry.segment_lengths, geometry.segment_lanes, geometry.speed_limits)
    )

    kind, share = np.full(S, EXIT, dtype=np.int64), np.zeros(S)
    parties = np.full((S, 3), -1, dtype=np.int64)
    parties[:, 0] = np.arange(S)
    for segments in (tuple(range(n)), *on, *off):
        for up, down in itertools.pairwise(segments):
            kind[up], parties[up, 1] = LINK, down
    for face, segments in zip(geometry.on_ramps, on, strict=True):
        main, joining = face - 1, segments[-1]
        kind[[main, joining]] = MERGE
        parties[main, 1:] = face, joining
        parties[joining, 1:] = face, main
    ramps = zip(geometry.off_ramps, off, geometry.exit_shares, strict=True)
    for face, segments, exit_share in ramps:
        kind[face - 1], share[face - 1] = DIVERGE, exit_share
        parties[face - 1, 1:] = face, segments[0]

    passing = [(parties[s, 1], s, 1.0 - share[s]) for s in range(S) if kind[s] != EXIT]
    passing += [(parties[s, 2], s, share[s]) for s in range(S) if share[s] > 0.0]
    passing.sort()
    edges = np.array([(s, end) for end, s, _ in passing], dtype=np.int64).reshape(-1, 2)
    edge_share = np.array([part for _, _, part in passing])

    stretch = np.zeros(S, dtype=np.int64)
    faces = np.concatenate([[0.0], np.cumsum(lengths[:n])])
    position = np.empty(S)
    position[:n] = 0.5 * (faces[:-1] + faces[1:])
    for ramp, (face, segments) in enumerate(
        zip((*geometry.on_ramps, *geometry.off_ramps), (*on, *off), strict=True)
    ):
        stretch[list(segments)], position[list(segments)] = 1 + ramp, faces[face]

    entry_cells = S + np.array([0, *range(2, 2 + n_on)], dtype=np.int64)
    exit_cells = S + np.array([1, *range(2 + n_on, 2 + n_on + n_off)], dtype=np.int64)
    entries, exits = beside[entry_cells - S], beside[exit_cells - S]
    exit_of = np.full(S, -1, dtype=np.int64)
    exit_of[exits] = np.arange(exits.size)
    neighbours = _neighbours(parties, edges)
    terms, term_share = _terms(parties, edges, edge_share, neighbours)
    return Road(
        n_mainline=n,
        n_segments=S,
        lengths=lengths,
        lanes=lanes,
        limits=limits,
        beside=beside,
        stretch=stretch,
        position=position,
        kind=kind,
        parties=parties,
        share=share,
        edges=edges,
        edge_share=edge_share,
        entries=entries,
        entry_cells=entry_cells,
        entry_inputs=np.array([0, *range(3, 3 + 2 * n_on, 2)], dtype=np.int64),
        exits=exits,
        exit_cells=exit_cells,
        exit_inputs=np.array([2, *range(3 + 2 * n_on, 3 + 2 * n_on + n_off)], dtype=np.int64),
        exit_of=exit_of,
        neighbours=neighbours,
        degree=(neighbours >= 0).sum(axis=1, dtype=np.int64),
        terms=terms,
        term_share=term_share,
    )


def _neighbours(parties: IntArray, edges: IntArray) -> IntArray:
    """Return the segments that a segment's next state depends on."""
    # An outflow depends on the segments at its face, a segment on what flows out of it and into.
    needed = [set(cells) for cells in parties.tolist()]
    for start, end in edges.tolist():
        needed[end] |= set(parties[start].tolist())
    lists = [[s, *sorted(cells - {s, -1})] for s, cells in enumerate(needed)]
    return np.array(list(itertools.zip_longest(*lists, fillvalue=-1)), dtype=np.int64).T.copy()


def _terms(
    parties: IntArray, edges: IntArray, edge_share: FloatArray, neighbours: IntArray
) -> tuple[IntArray, FloatArray]:
    """Return the terms of a step's Jacobian, and their shares."""
    flows = [(s, s, -1.0) for s in range(len(parties))]
    pairs = zip(edges.tolist(), edge_share, strict=True)
    flows += [(start, end, float(share)) for (start, end), share in pairs]
    columns, terms, shares = neighbours.tolist(), [], []
    for start, row, share in flows:
        for party, cell in enumerate(parties[start].tolist()):
            if cell >= 0:
                terms.append((row, columns[row].index(cell), start, party))
                shares.append(share)
    return np.array(terms, dtype=np.int64), np.array(shares)
