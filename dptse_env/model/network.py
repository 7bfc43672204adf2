"""Geometry of a road as arrays: cells and their connections, and the rows of a measurement.

`Layout` is derived of a `RoadNetwork` alone. Kernels take `RoadArrays`, which have the numbers of a
model on it as well; see `ARZModel.road`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class RoadNetwork(Protocol):
    """The properties of a corridor that the model needs.

    Segments are ordered: mainline 0..N-1, then on-ramps, then off-ramps (S in all), each in the
    direction of travel. On-ramp `on_ramps[i] = j` joins at the face between mainline segments j-1
    and j; off-ramp `off_ramps[o] = j` leaves at the face between j-1 and j and takes
    `exit_shares[o]` of the flow.
    """

    @property
    def n_mainline(self) -> int:
        """Number of mainline segments N."""

    @property
    def on_ramps(self) -> Sequence[int]:
        """For each on-ramp the mainline segment it feeds."""

    @property
    def off_ramps(self) -> Sequence[int]:
        """For each off-ramp the mainline segment downstream of it."""

    @property
    def exit_shares(self) -> Sequence[float]:
        """For each off-ramp the share of the flow that takes it."""

    @property
    def on_ramp_segments(self) -> Sequence[Sequence[int]]:
        """Segments of each on-ramp, in the direction of travel."""

    @property
    def off_ramp_segments(self) -> Sequence[Sequence[int]]:
        """Segments of each off-ramp, in the direction of travel."""

    @property
    def segment_lengths(self) -> Sequence[float]:
        """Length of each of the S segments [km]."""

    @property
    def speed_limits(self) -> Sequence[float]:
        """Speed limit of each of the S segments [km/h]; the dynamics do without it."""

    @property
    def segment_lanes(self) -> Sequence[int]:
        """Lanes of each of the S segments."""

    @property
    def boundary_lanes(self) -> Sequence[int]:
        """Lanes of each of the R boundary cells: both ends of the mainline, then the ramps'."""


LINK, MERGE, DIVERGE, EXIT = 0, 1, 2, 3


@dataclass(frozen=True)
class Layout:
    """The cells of a road, one per segment, and the faces through which traffic passes.

    A cell flows out through one face: into one cell (LINK), into one that another cell flows into
    as well (MERGE), into two cells (DIVERGE), or out of the road (EXIT).
    """

    lanes: FloatArray  # (S,)
    lengths: FloatArray  # (S,) [km]
    kind: IntArray  # (S,) LINK, MERGE, DIVERGE or EXIT: the face a cell flows out through
    # (S, 3) the cell, the cell it flows into, and the third one at a junction (the other
    # branch of a merge, the off-ramp of a diverge), -1 where there is none
    parties: IntArray
    share: FloatArray  # (S,) exit share of a diverge, 0 elsewhere
    edges: IntArray  # (E, 2) cells (from, to) between which vehicles pass
    edge_shares: FloatArray  # (E,) share of the outflow that passes along each edge
    entries: IntArray  # (1 + I,) cells with inflow from outside: segment 0, then the on-ramps
    entry_inputs: IntArray  # (1 + I,) input column of each entry's demand; its w follows
    entry_boundaries: IntArray  # (1 + I,) boundary cell before each entry
    entry_lanes: FloatArray  # (1 + I,) lanes of these
    exits: IntArray  # (1 + O,) cells with outflow to outside: segment N-1, then the off-ramps
    exit_inputs: IntArray  # (1 + O,) input column of each exit's downstream density
    exit_boundaries: IntArray  # (1 + O,) boundary cell after each exit
    exit_lanes: FloatArray  # (1 + O,) lanes of these

    @property
    def n_segments(self) -> int:
        """Number of segments S."""
        return self.lanes.size

    @property
    def n_inputs(self) -> int:
        """Length of the input vector: 3 + 2 I + O."""
        return 2 * self.entries.size + self.exits.size

    @property
    def n_boundaries(self) -> int:
        """Number of boundary cells R."""
        return self.entries.size + self.exits.size

    def neighbours(self) -> IntArray:
        """Cells that a cell's next state depends on, itself first, shape (S, K), -1 padded."""
        # An outflow depends on the cells at its face, and a cell on what flows out of it and into.
        needed = [set(cells) for cells in self.parties.tolist()]
        for start, end in self.edges.tolist():
            needed[end] |= set(self.parties[start].tolist())
        lists = [[c, *sorted(cells - {c, -1})] for c, cells in enumerate(needed)]
        return np.array(list(itertools.zip_longest(*lists, fillvalue=-1)), dtype=np.int64).T.copy()

    def terms(self) -> tuple[IntArray, FloatArray]:
        """Terms of a step's Jacobian: each outflow's gradient in the rows of the cells it moves.

        Returns:
            The terms (M, 4): the row's cell, the slot among its `neighbours` of the cell by which
            is derived, the outflow's cell, and the place of the former among its `parties`; and
            their weights (M,), -1 in the row of the outflow's cell and the edge's share else.
        """
        flows = [(c, c, -1.0) for c in range(self.n_segments)]
        edges = zip(self.edges.tolist(), self.edge_shares.tolist(), strict=True)
        flows += [(start, end, share) for (start, end), share in edges]
        neighbours, terms, weights = self.neighbours().tolist(), [], []
        for start, row, weight in flows:
            for party, cell in enumerate(self.parties[start].tolist()):
                if cell >= 0:
                    terms.append((row, neighbours[row].index(cell), start, party))
                    weights.append(weight)
        return np.array(terms, dtype=np.int64), np.array(weights)


def make_layout(network: RoadNetwork) -> Layout:
    """Derive the arrays of a network.

    Raises:
        ValueError: The model does not cover the geometry; the message names the field.
    """
    _check(network)
    n, n_on, n_off = network.n_mainline, len(network.on_ramps), len(network.off_ramps)
    on, off = network.on_ramp_segments, network.off_ramp_segments
    lanes = np.asarray(network.segment_lanes, dtype=np.float64)
    S = lanes.size

    kind, share = np.full(S, EXIT, dtype=np.int64), np.zeros(S)
    parties = np.full((S, 3), -1, dtype=np.int64)
    parties[:, 0] = np.arange(S)
    for path in (range(n), *on, *off):
        for up, down in itertools.pairwise(path):
            kind[up], parties[up, 1] = LINK, down
    for face, ramp in zip(network.on_ramps, on, strict=True):
        main, joining = face - 1, ramp[-1]
        kind[[main, joining]] = MERGE
        parties[main, 1:] = face, joining
        parties[joining, 1:] = face, main
    ramps = zip(network.off_ramps, off, network.exit_shares, strict=True)
    for face, ramp, exit_share in ramps:
        kind[face - 1], share[face - 1] = DIVERGE, exit_share
        parties[face - 1, 1:] = face, ramp[0]

    passing = [(parties[c, 1], c, 1.0 - share[c]) for c in range(S) if kind[c] != EXIT]
    passing += [(parties[c, 2], c, share[c]) for c in range(S) if share[c] > 0.0]
    passing.sort()

    entry_boundaries = np.array([0, *range(2, 2 + n_on)], dtype=np.int64)
    exit_boundaries = np.array([1, *range(2 + n_on, 2 + n_on + n_off)], dtype=np.int64)
    boundary_lanes = np.asarray(network.boundary_lanes, dtype=np.float64)
    return Layout(
        lanes=lanes,
        lengths=np.asarray(network.segment_lengths, dtype=np.float64),
        kind=kind,
        parties=parties,
        share=share,
        edges=np.array([(c, end) for end, c, _ in passing], dtype=np.int64).reshape(-1, 2),
        edge_shares=np.array([part for _, _, part in passing]),
        entries=np.array([0, *(ramp[0] for ramp in on)], dtype=np.int64),
        entry_inputs=np.array([0, *range(3, 3 + 2 * n_on, 2)], dtype=np.int64),
        entry_boundaries=entry_boundaries,
        entry_lanes=boundary_lanes[entry_boundaries],
        exits=np.array([n - 1, *(ramp[-1] for ramp in off)], dtype=np.int64),
        exit_inputs=np.array([2, *range(3 + 2 * n_on, 3 + 2 * n_on + n_off)], dtype=np.int64),
        exit_boundaries=exit_boundaries,
        exit_lanes=boundary_lanes[exit_boundaries],
    )


def _check(network: RoadNetwork) -> None:
    n = network.n_mainline
    if n < 1:
        raise ValueError(f"network.n_mainline must be >= 1, got {n}")
    taken: set[int] = set()
    for field, faces in (("on_ramps", network.on_ramps), ("off_ramps", network.off_ramps)):
        for i, face in enumerate(faces):
            path = f"network.{field}[{i}]"
            if not 1 <= face <= n - 1:
                raise ValueError(f"{path} must be in 1..{n - 1}, got {face}")
            if face in taken:
                raise ValueError(f"{path} must be a face without another ramp, got {face}")
            taken.add(face)
    if len(network.exit_shares) != len(network.off_ramps):
        raise ValueError(
            f"network.exit_shares must have {len(network.off_ramps)} entries, one per off-ramp, "
            f"got {len(network.exit_shares)}"
        )
    for i, share in enumerate(network.exit_shares):
        if not 0.0 <= share < 1.0:
            raise ValueError(f"network.exit_shares[{i}] must be in [0, 1), got {share}")
    n_segments = n + sum(map(len, (*network.on_ramp_segments, *network.off_ramp_segments)))
    n_boundaries = 2 + len(network.on_ramps) + len(network.off_ramps)
    for field, size in (
        ("segment_lengths", n_segments),
        ("segment_lanes", n_segments),
        ("boundary_lanes", n_boundaries),
    ):
        values = getattr(network, field)
        if len(values) != size:
            raise ValueError(f"network.{field} must have {size} entries, got {len(values)}")
        for i, value in enumerate(values):
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"network.{field}[{i}] must be finite and > 0, got {value}")


def covered(first: IntArray, span: IntArray, n: int) -> BoolArray:
    """Return flags of n neighbours in a row: True for `span` of them from `first` on.

    Shape (M, n), for `first` and `span` of shape (M,).
    """
    place = np.arange(n) - first[:, None]
    inside: BoolArray = (place >= 0) & (place < span[:, None])
    return inside


@dataclass(frozen=True, eq=False)
class MeasurementRows:
    """The M rows that a measurement may have, each an average over neighbouring segments.

    A row has two numbers: the average density, and the average centred flow, of its segments.

    Attributes:
        first: The first segment of each row, shape (M,).
        span: The number of segments of each row, shape (M,).
        n_segments: Segments S of the road.

    Raises:
        ValueError: A row is empty or leaves the road.
    """

    first: IntArray
    span: IntArray
    n_segments: int

    def __post_init__(self) -> None:
        """Check that every row lies on the road."""
        for row, (first, span) in enumerate(zip(self.first, self.span, strict=True)):
            if not (span >= 1 and first >= 0 and first + span <= self.n_segments):
                raise ValueError(
                    f"rows[{row}] must cover segments in 0..{self.n_segments - 1}, got "
                    f"{span} from {first} on"
                )

    @classmethod
    def single(cls, n_segments: int) -> MeasurementRows:
        """Return the rows of a road whose segments are measured one by one."""
        return cls(np.arange(n_segments), np.ones(n_segments, dtype=np.int64), n_segments)

    @property
    def n_rows(self) -> int:
        """Number of rows M."""
        return self.first.size

    @cached_property
    def are_single(self) -> bool:
        """True if row s is segment s, for all segments."""
        every = np.arange(self.n_segments)
        return bool((self.span == 1).all()) and np.array_equal(self.first, every)

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of the segments in each row, shape (M, S): 1 / span of those it covers."""
        inside = covered(self.first, self.span, self.n_segments)
        return np.where(inside, 1.0 / self.span[:, None], 0.0)

    def averages(self, values: FloatArray) -> FloatArray:
        """Return the rows' averages, shape (n, M, 2), of values of shape (n, S, 2)."""
        if self.are_single:
            return values
        averages: FloatArray = np.einsum("ms,nsk->nmk", self.weights, values)
        return averages


class RoadArrays(NamedTuple):
    """A model of S segments as arrays and numbers, for compiled code; nothing changes them."""

    free_flow_speed: float  # v_f [km/h]
    gamma: float  # Exponent of the pressure
    step_ratio: FloatArray  # (S,) T / l [h/km]
    relaxation: float  # T / tau
    jam: FloatArray  # (S,) jam densities [veh/km]
    outside_jam: FloatArray  # (S,) jam density behind an exit [veh/km]; unused elsewhere
    kind: IntArray  # (S,) of `Layout`
    parties: IntArray  # (S, 3) of `Layout`
    share: FloatArray  # (S,) of `Layout`
    entry: IntArray  # (S,) input column of the demand from outside, -1 for an inner cell
    entries: IntArray  # (1 + I,) cells with inflow from outside
    exit: IntArray  # (S,) input column of the density outside, -1 for an inner cell
    edges: IntArray  # (E, 2) of `Layout`
    edge_share: FloatArray  # (E,) share of the outflow that passes
    neighbours: IntArray  # (S, K) of `Layout`
    degree: IntArray  # (S,) how many neighbours there are
    terms: IntArray  # (M, 4) of `Layout`
    term_weight: FloatArray  # (M,) weight of the outflow's gradient in the Jacobian [h/km]
    second_scale: float  # unit of the second number that sensors release [km/h or veh/h]
    row_first: IntArray  # (M,) first segment of each row of a measurement
    row_span: IntArray  # (M,) segments of each row

    def __deepcopy__(self, memo: object) -> RoadArrays:
        """Return the same arrays, which copies of a filter share."""
        return self
