"""Localisation: weights of covariances by the distance along the road."""

from typing import NamedTuple

import numpy as np

from dptse_env.model import ARZModel
from dptse_env.model.network import RoadNetwork
from dptse_env.utils.arrays import FloatArray


def positions(network: RoadNetwork) -> FloatArray:
    """Return the positions of segments along the road `(S,)` [km], from its upstream end.

    Mainline segments lie at their centres, ramps at the face where they join or leave.
    """
    lengths = np.array(network.segment_lengths[: network.n_mainline])
    faces = np.concatenate([[0.0], np.cumsum(lengths)])
    along = np.empty(len(network.segment_lengths))
    along[: network.n_mainline] = faces[:-1] + 0.5 * lengths
    ramps = zip(
        (*network.on_ramps, *network.off_ramps),
        (*network.on_ramp_segments, *network.off_ramp_segments),
        strict=True,
    )
    for face, segments in ramps:
        along[list(segments)] = faces[face]
    return along


def gaspari_cohn(distance: FloatArray, reach: float) -> FloatArray:
    """Correlation with compact support (Gaspari and Cohn, 1999, eq. 4.10).

    A fifth-order piecewise rational function, close to a normal density in shape: 1 at distance 0,
    5/24 at half of `reach` > 0, 0 from `reach` on. Distances >= 0 have any shape.
    """
    z = 2.0 * np.asarray(distance, dtype=np.float64) / reach
    near = 1.0 + z**2 * (-5.0 / 3.0 + z * (5.0 / 8.0 + z * (0.5 - 0.25 * z)))
    away = np.clip(z, 1.0, 2.0)  # avoids a division by zero in the unused branch
    inner = 5.0 / 3.0 + away * (5.0 / 8.0 + away * (-0.5 + away / 12.0))
    far = 4.0 + away * (-5.0 + away * inner) - 2.0 / (3.0 * away)
    return np.where(z <= 1.0, near, np.where(z < 2.0, np.maximum(far, 0.0), 0.0))


def tapers(network: RoadNetwork, reach: float) -> FloatArray:
    """Return weights `(S, S)` of covariances between segments, zero beyond a reach [km].

    Every segment has a position on a line, where the function is a correlation: the matrix is
    positive semidefinite, and so is its element-wise product with a covariance (Schur). Distances
    that include the ramps would not guarantee that.
    """
    x = positions(network)
    return gaspari_cohn(np.abs(x[:, None] - x), reach)


class RowTapers(NamedTuple):
    """Weights of the covariances of M rows of a measurement."""

    with_states: FloatArray  # (M, n_x) with the components of the state
    among_rows: FloatArray  # (M, M)


def row_tapers(model: ARZModel, reach: float) -> RowTapers:
    """Return weights for the rows of a model's measurements, zero beyond a reach [km].

    A row over several segments has the average weight of its segments, and a demand factor lies
    where its entry does. With T the weights between segments, W those of the segments in the rows
    and C the choice of a segment for each component, all weights are blocks of `[C; W] T [C; W]'`,
    which is positive semidefinite as T is.
    """
    weights = model.rows.weights
    by_segment = weights @ tapers(model.network, reach)
    entries = model.layout.entries[: model.n_demand_states]
    segments = np.concatenate([np.repeat(np.arange(model.n_segments), 2), entries])
    return RowTapers(
        with_states=np.ascontiguousarray(by_segment[:, segments]),
        among_rows=by_segment @ weights.T,
    )
