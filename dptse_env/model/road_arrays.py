"""A model as arrays and numbers, for compiled code."""

from typing import NamedTuple

import numpy as np

from dptse_env.model.arz import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray

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


def make_road_arrays(model: ARZModel) -> RoadArrays:
    """Return a model as arrays and numbers."""
    layout, n = model.layout, model.n_segments
    kind = np.full(n, EXIT, dtype=np.int64)
    parties = np.full((n, 3), -1, dtype=np.int64)
    parties[:, 0] = np.arange(n)
    share = np.zeros(n)
    for up, down in layout.links.T:
        kind[up], parties[up, 1] = LINK, down
    for main, ramp, down in layout.merges.T:
        kind[[main, ramp]] = MERGE
        parties[main, 1:] = down, ramp
        parties[ramp, 1:] = down, main
    for (up, main, off), exit_share in zip(layout.diverges.T, layout.exit_shares, strict=True):
        kind[up], share[up] = DIVERGE, exit_share
        parties[up, 1:] = main, off

    entry, leave = np.full((2, n), -1, dtype=np.int64)
    entry[layout.entries] = layout.entry_inputs
    leave[layout.exits] = layout.exit_inputs
    outside_jam = np.zeros(n)
    outside_jam[layout.exits] = model.exit_jam_density

    edges, edge_share = layout.edges, layout.edge_shares
    neighbours, degree = _neighbours(model)
    terms, weights = _terms(parties, edges, edge_share, neighbours)
    return RoadArrays(
        free_flow_speed=float(model.parameters.free_flow_speed),
        gamma=float(model.parameters.gamma),
        step_ratio=model.step_ratio,
        relaxation=float(model.relaxation),
        jam=model.jam_density,
        outside_jam=outside_jam,
        kind=kind,
        parties=parties,
        share=share,
        entry=entry,
        entries=layout.entries,
        exit=leave,
        edges=edges,
        edge_share=edge_share,
        neighbours=neighbours,
        degree=degree,
        terms=terms,
        term_weight=model.step_ratio[terms[:, 0]] * weights,
        second_scale=float(model.measurement_scale[1]),
        row_first=model.rows.first,
        row_span=model.rows.span,
    )


def _neighbours(model: ARZModel) -> tuple[IntArray, IntArray]:
    sparsity = model.layout.sparsity()
    degree = sparsity.sum(axis=1).astype(np.int64)
    neighbours = np.full((model.n_segments, int(degree.max())), -1, dtype=np.int64)
    for cell, row in enumerate(sparsity):
        cells = np.flatnonzero(row)
        neighbours[cell, : degree[cell]] = [cell, *cells[cells != cell]]
    return neighbours, degree


def _terms(
    parties: IntArray, edges: IntArray, edge_share: FloatArray, neighbours: IntArray
) -> tuple[IntArray, FloatArray]:
    """List the rows of the Jacobian that each outflow's gradient enters, with its weights."""
    flows = [(cell, cell, -1.0) for cell in range(len(parties))]
    flows += [(start, end, part) for (start, end), part in zip(edges, edge_share, strict=True)]
    terms, weights = [], []
    for start, row, weight in flows:
        for party, cell in enumerate(parties[start]):
            if cell >= 0:
                slot = int(np.flatnonzero(neighbours[row] == cell)[0])
                terms.append((row, slot, start, party))
                weights.append(weight)
    return np.array(terms, dtype=np.int64), np.array(weights)
