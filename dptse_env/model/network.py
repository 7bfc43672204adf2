"""Geometry of a road as arrays: cells and their connections, rows, and what kernels take of it.

`Layout` is derived of a `RoadNetwork`, and `RoadArrays` of a model on it.
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


@dataclass(frozen=True)
class Layout:
    """Index arrays of a road network, each face in exactly one group."""

    links: IntArray  # (2, L) cells (upstream, downstream) of 1-to-1 faces
    merges: IntArray  # (3, I) cells (mainline, on-ramp, downstream)
    diverges: IntArray  # (3, O) cells (upstream, mainline, off-ramp)
    exit_shares: FloatArray  # (O,) share of the flow that leaves at each diverge
    entries: IntArray  # (1 + I,) cells with inflow from outside: segment 0, then the on-ramps
    entry_inputs: IntArray  # (1 + I,) input column of each entry's demand; its w follows
    exits: IntArray  # (1 + O,) cells with outflow to outside: segment N-1, then the off-ramps
    exit_inputs: IntArray  # (1 + O,) input column of each exit's downstream density
    routing: FloatArray  # (S, S) share of the outflow of a column's cell into a row's cell
    lanes: FloatArray  # (S,) lanes of the segments
    lengths: FloatArray  # (S,) lengths of the segments [km]
    entry_lanes: FloatArray  # (1 + I,) lanes of the boundary cells before the entries
    exit_lanes: FloatArray  # (1 + O,) lanes of the boundary cells after the exits

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

    @property
    def entry_boundaries(self) -> IntArray:
        """`(1 + I,)` boundary cell before each entry, in the order of a record."""
        return np.array([0, *range(2, 1 + self.entries.size)], dtype=np.int64)

    @property
    def exit_boundaries(self) -> IntArray:
        """`(1 + O,)` boundary cell after each exit, in the order of a record."""
        first = 1 + self.entries.size
        return np.array([1, *range(first, self.n_boundaries)], dtype=np.int64)

    @property
    def edges(self) -> IntArray:
        """`(E, 2)` cells (from, to) between which vehicles pass."""
        ends, starts = np.nonzero(self.routing)
        return np.stack([starts, ends], axis=1).astype(np.int64)

    @property
    def edge_shares(self) -> FloatArray:
        """`(E,)` share of the outflow that passes along each edge."""
        shares: FloatArray = self.routing[self.edges[:, 1], self.edges[:, 0]]
        return shares

    def sparsity(self) -> BoolArray:
        """`(S, S)` flags: the cell of a row after a step depends on that of a column before it."""
        # The outflow of a cell depends on every cell at its downstream face.
        outflow = np.eye(self.n_segments, dtype=bool)
        for cells in (*self.links.T, *self.diverges.T):
            outflow[cells[0], cells] = True
        for main, ramp, down in self.merges.T:
            outflow[[[main], [ramp]], [main, ramp, down]] = True
        inflow = (self.routing > 0) @ outflow
        return np.asarray(inflow | outflow, dtype=np.bool_)


def make_layout(network: RoadNetwork) -> Layout:
    """Derive the index arrays of a network.

    Raises:
        ValueError: The model does not cover the geometry; the message names the field.
    """
    _check(network)
    n, n_on, n_off = network.n_mainline, len(network.on_ramps), len(network.off_ramps)
    on, off = network.on_ramp_segments, network.off_ramp_segments
    shares = np.asarray(network.exit_shares, dtype=np.float64)
    lanes = np.asarray(network.segment_lanes, dtype=np.float64)
    boundary_lanes = np.asarray(network.boundary_lanes, dtype=np.float64)

    merges = [(face - 1, ramp[-1], face) for face, ramp in zip(network.on_ramps, on, strict=True)]
    diverges = [
        (face - 1, face, ramp[0]) for face, ramp in zip(network.off_ramps, off, strict=True)
    ]
    junctions = {*network.on_ramps, *network.off_ramps}
    links = [(j - 1, j) for j in range(1, n) if j not in junctions]
    for ramp in (*on, *off):
        links += itertools.pairwise(ramp)

    routing = np.zeros((lanes.size,) * 2)
    for up, down in links:
        routing[down, up] = 1.0
    for main, joining, down in merges:
        routing[down, [main, joining]] = 1.0
    for (up, main, leaving), share in zip(diverges, shares, strict=True):
        routing[[main, leaving], up] = 1.0 - share, share

    return Layout(
        links=_columns(links, 2),
        merges=_columns(merges, 3),
        diverges=_columns(diverges, 3),
        exit_shares=shares,
        entries=np.array([0, *(ramp[0] for ramp in on)], dtype=np.int64),
        entry_inputs=np.array([0, *range(3, 3 + 2 * n_on, 2)], dtype=np.int64),
        exits=np.array([n - 1, *(ramp[-1] for ramp in off)], dtype=np.int64),
        exit_inputs=np.array([2, *range(3 + 2 * n_on, 3 + 2 * n_on + n_off)], dtype=np.int64),
        routing=routing,
        lanes=lanes,
        lengths=np.asarray(network.segment_lengths, dtype=np.float64),
        entry_lanes=boundary_lanes[[0, *range(2, 2 + n_on)]],
        exit_lanes=boundary_lanes[[1, *range(2 + n_on, 2 + n_on + n_off)]],
    )


def _columns(rows: Sequence[tuple[int, ...]], width: int) -> IntArray:
    return np.array(rows, dtype=np.int64).reshape(-1, width).T


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


LINK, MERGE, DIVERGE, EXIT = 0, 1, 2, 3


class RoadArrays(NamedTuple):
    """A model of S segments as arrays and numbers, for compiled code."""

    free_flow_speed: float  # v_f [km/h]
    gamma: float  # Exponent of the pressure
    step_ratio: FloatArray  # (S,) T / l [h/km]
    relaxation: float  # T / tau
    jam: FloatArray  # (S,) jam densities [veh/km]
    outside_jam: FloatArray  # (S,) jam density behind an exit [veh/km]; unused elsewhere
    kind: IntArray  # (S,) LINK, MERGE, DIVERGE or EXIT: the face a cell flows out through
    # (S, 3) the cell, the cell it flows into, and the third one at a junction (the other
    # branch of a merge, the off-ramp of a diverge), -1 where there is none
    parties: IntArray
    share: FloatArray  # (S,) exit share of a diverge
    entry: IntArray  # (S,) input column of the demand from outside, -1 for an inner cell
    entries: IntArray  # (1 + I,) cells with inflow from outside
    exit: IntArray  # (S,) input column of the density outside, -1 for an inner cell
    edges: IntArray  # (E, 2) cells (from, to) between which vehicles pass
    edge_share: FloatArray  # (E,) share of the outflow that passes
    # (S, K) cells that a cell's next state depends on, itself first, -1 padded
    neighbours: IntArray
    degree: IntArray  # (S,) how many neighbours there are
    terms: IntArray  # (M, 4) (row cell, slot of its neighbour, outflow's cell, its party)
    term_weight: FloatArray  # (M,) weight of the outflow's gradient in the Jacobian [h/km]
    second_scale: float  # unit of the second number that sensors release [km/h or veh/h]
    row_first: IntArray  # (M,) first segment of each row of a measurement
    row_span: IntArray  # (M,) segments of each row
