"""A road and its measurements as a recurrent network sees them: cell by cell, in its own units.

The network has no parameters of a road. Each cell (a mainline segment or a ramp) gets the same
`CHANNELS`, so that one network serves any road and any release model.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators.batch import Measurements
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray

DENSITY_UNIT = 40.0
"""Unit of densities [veh/km] for each lane, between free flow and a jam."""
DENSITY_RANGE = 4.0
"""Largest density that is estimated, in its unit: vehicles that stand, 6.25 m each."""
SPEED_RANGE = 1.1
"""Largest speed that is estimated, in speed limits."""
LEAST_DENSITY = 0.04
"""Least density, in its unit, by which a flow is divided."""
LONGEST_AGE = 300.0
"""Seconds since a measurement after which a cell counts as never measured."""

MEASURED = (
    "queried", "density", "density_sigma", "second", "second_sigma", "centre", "log_span",
    "shared_upstream", "shared_downstream",
)  # fmt: skip
"""Numbers that `cell_measurements` gives of each cell."""

CHANNELS = (
    "queried", "density", "log_density_sigma", "flow", "log_flow_sigma", "centre", "speed",
    "log_speed_sigma", "density_news", "speed_news", "flows", "log_span", "shared_upstream",
    "shared_downstream", "log_age", "predicted_density", "predicted_speed", "inflow",
    "outside_density", "on_ramp", "off_ramp", "entry", "exit", "lanes", "log_length", "log_limit",
)  # fmt: skip
"""The inputs of the network for each cell."""

N_FIXED = 7
"""Channels at the end that never change."""


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
    limit: float  # speed limit [km/h]
    flows: bool  # whether flows are released, otherwise speeds
    row_first: IntArray  # (M,) first cell of each row of a measurement
    row_span: IntArray  # (M,) number of cells of each row
    fixed: FloatArray  # (S, N_FIXED) channels that never change


def make_cells(model: ARZModel) -> Cells:
    """Return the cells of a model's road, and of the measurements that it may get."""
    network, layout = model.network, model.layout
    n, n_on, S = network.n_mainline, len(network.on_ramps), layout.n_segments
    marks = np.zeros((S, 4))
    marks[n : n + n_on, 0] = 1.0
    marks[n + n_on :, 1] = 1.0
    marks[layout.entries, 2] = 1.0
    marks[layout.exits, 3] = 1.0
    length, limit = network.segment_length, network.speed_limit
    scales = np.broadcast_to([np.log(length / 0.1), np.log(limit / 100.0)], (S, 2))
    return Cells(
        edges=layout.edges,
        entries=layout.entries,
        entry_inputs=layout.entry_inputs,
        exits=layout.exits,
        exit_inputs=layout.exit_inputs,
        exit_units=DENSITY_UNIT * layout.exit_lanes,
        lanes=layout.lanes,
        unit=DENSITY_UNIT * layout.lanes,
        limit=float(limit),
        flows=model.reference_speed is not None,
        row_first=model.rows.first,
        row_span=model.rows.span,
        fixed=np.concatenate([marks, layout.lanes[:, None] / 3.0, scales], axis=1),
    )


def cell_measurements(cells: Cells, measured: Measurements) -> FloatArray:
    """Return `MEASURED` of every cell, shape (k, S, 9), in the units of the release.

    Rows that overlap are averaged with the inverses of their variances; the span is that of the row
    with the least.
    """
    k, S = len(measured.episodes), cells.lanes.size
    table = np.zeros((k, S, len(MEASURED)))
    weight = np.zeros((k, S, 2))
    total = np.zeros((k, S, 2))
    best = np.zeros((k, S))
    for m in range(cells.row_first.size):
        seen = measured.observed[:, m]
        if not seen.any():
            continue
        first, span = cells.row_first[m], cells.row_span[m]
        own = 1.0 / np.maximum(measured.sigma[seen, m], 1e-12) ** 2
        for s in range(first, first + span):
            weight[seen, s] += own
            total[seen, s] += own * measured.values[seen, m]
            better = seen.copy()
            better[seen] = own[:, 0] > best[seen, s]
            best[better, s] = own[better[seen], 0]
            table[better, s, 6] = np.log(span)
            table[better, s, 7] = float(s > first)
            table[better, s, 8] = float(s < first + span - 1)
    queried = weight[..., 0] > 0.0
    safe = np.where(queried[..., None], weight, 1.0)
    table[..., 0] = queried
    table[..., 1:4:2] = total / safe
    table[..., 2:5:2] = np.where(queried[..., None], 1.0 / np.sqrt(safe), 0.0)
    if cells.flows:
        table[..., 5] = measured.centre
    return table


def input_channels(cells: Cells, inputs: FloatArray) -> FloatArray:
    """Return inflow and density outside, shape (k, S, 2), of the model's inputs (k, n_u)."""
    table = np.zeros((len(inputs), cells.lanes.size, 2))
    lanes = cells.lanes[cells.entries]
    table[:, cells.entries, 0] = inputs[:, cells.entry_inputs] / (2000.0 * lanes)
    table[:, cells.exits, 1] = inputs[:, cells.exit_inputs] / cells.exit_units
    return table


def channels(
    xp: ModuleType,
    cells: Any,
    measured: Any,
    predicted: Any,
    age: Any,
    outside: Any,
) -> Any:
    """Return the network's inputs, shape (k, S, 26), in the order of `CHANNELS`.

    Args:
        xp: numpy or torch, of which the other arguments are arrays.
        cells: Has ``unit`` (S,), ``limit``, ``flows`` (1 or 0, or (k, 1) of them) and ``fixed``
            (k, S, N_FIXED).
        measured: Shape (k, S, 9), from `cell_measurements`.
        predicted: Predicted density [veh/km] and speed [km/h], shape (k, S, 2).
        age: Seconds since the last measurement before this one, shape (k, S).
        outside: Shape (k, S, 2), from `input_channels`.
    """
    queried, unit, limit = measured[..., 0], cells.unit, cells.limit
    density = predicted[..., 0] / unit
    carrier = xp.clip(density, LEAST_DENSITY, None)
    second, sigma = measured[..., 3] / limit, measured[..., 4] / limit
    flows, centre = cells.flows, measured[..., 5] / limit
    by_density = flows / carrier / unit + (1.0 - flows)
    read_density = xp.clip(measured[..., 1] / unit, -8.0, 8.0)
    read_speed = xp.clip(centre + second * by_density, -1.0, 2.0)
    parts = [
        queried,
        queried * read_density,
        queried * _log(xp, measured[..., 2] / unit),
        xp.clip(flows * queried * second / unit, -4.0, 4.0),
        flows * queried * _log(xp, sigma / unit),
        centre,
        queried * read_speed,
        queried * _log(xp, sigma * by_density),
        queried * (read_density - density),
        queried * (read_speed - predicted[..., 1] / limit),
        queried * 0.0 + flows,
        measured[..., 6],
        measured[..., 7],
        measured[..., 8],
        0.25 * xp.log(1.0 + xp.clip(age, 0.0, LONGEST_AGE)),
        density,
        predicted[..., 1] / limit,
    ]
    return xp.concatenate([xp.stack(parts, -1), outside, cells.fixed], -1)


def _log(xp: ModuleType, deviation: Any) -> Any:
    """Return half the logarithm of a deviation, held to what training has seen."""
    return 0.5 * xp.log(xp.clip(deviation, 1e-3, 20.0))
