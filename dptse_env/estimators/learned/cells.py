"""The cells of a road as a recurrent network sees them, each in its own units.

The network has no parameters of a road. Each cell (a mainline segment or a ramp) is described by
the same numbers, so that one network serves any road.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray

DENSITY_UNIT = 40.0
"""Unit of densities [veh/km] for each lane, between free flow and a jam."""
DENSITY_RANGE = 4.0
"""Largest density that is estimated, in its unit: vehicles that stand, 6.25 m each."""
SPEED_RANGE = 1.1
"""Largest speed that is estimated, in speed limits."""

N_FIXED = 7
"""Numbers of a cell that never change."""


class Cells(NamedTuple):
    """The cells of a road."""

    edges: IntArray  # (E, 2) cells (from, to) between which vehicles pass
    entries: IntArray  # (1 + I,) cells with inflow from outside
    entry_inputs: IntArray  # (1 + I,) column of the model's inputs with the inflow [veh/h]
    exits: IntArray  # (1 + O,) cells with outflow to outside
    exit_inputs: IntArray  # (1 + O,) column of the model's inputs with the density there [veh/km]
    exit_units: FloatArray  # (1 + O,) unit of that density [veh/km]
    lanes: FloatArray  # (S,)
    unit: FloatArray  # (S,) unit of densities [veh/km]
    limit: float  # largest speed limit [km/h], the unit of speeds
    flows: bool  # whether flows are released, otherwise speeds
    row_first: IntArray  # (M,) first cell of each row of a measurement
    row_span: IntArray  # (M,) number of cells of each row
    fixed: FloatArray  # (S, N_FIXED) numbers that never change


def make_cells(model: ARZModel) -> Cells:
    """Return the cells of a model's road, and of the measurements that it may get."""
    network, layout = model.network, model.layout
    marks = np.zeros((layout.n_segments, 4))
    for kind, ramps in enumerate((network.on_ramp_segments, network.off_ramp_segments)):
        for segments in ramps:
            marks[list(segments), kind] = 1.0
    marks[layout.entries, 2] = 1.0
    marks[layout.exits, 3] = 1.0
    limits = np.array(network.speed_limits)
    scales = np.stack([np.log(layout.lengths / 0.1), np.log(limits / 100.0)], axis=1)
    return Cells(
        edges=layout.edges,
        entries=layout.entries,
        entry_inputs=layout.entry_inputs,
        exits=layout.exits,
        exit_inputs=layout.exit_inputs,
        exit_units=DENSITY_UNIT * layout.exit_lanes,
        lanes=layout.lanes,
        unit=DENSITY_UNIT * layout.lanes,
        limit=float(limits.max()),
        flows=model.reference_speed is not None,
        row_first=model.rows.first,
        row_span=model.rows.span,
        fixed=np.concatenate([marks, layout.lanes[:, None] / 3.0, scales], axis=1),
    )


def input_channels(cells: Cells, inputs: FloatArray) -> FloatArray:
    """Return inflow and density outside, shape (k, S, 2), of the model's inputs (k, n_u)."""
    table = np.zeros((len(inputs), cells.lanes.size, 2))
    lanes = cells.lanes[cells.entries]
    table[:, cells.entries, 0] = inputs[:, cells.entry_inputs] / (2000.0 * lanes)
    table[:, cells.exits, 1] = inputs[:, cells.exit_inputs] / cells.exit_units
    return table
