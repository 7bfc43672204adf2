"""Covariances that reach a band along the road: how the compiled filters store them.

The components of a state are taken in the order in which they lie along the road: those of a
segment, its demand factor if it has one, those of the next segment or ramp. A component's number
in this order is its place; the components of one segment are a group. Of a
covariance P, row i has the entries with the places from i - H to i in its columns 0 to H, where H
is the reach of the band in places.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.localisation import in_road_order, state_places
from dptse_env.model import ARZModel
from dptse_env.model.model import make_road_arrays
from dptse_env.utils.arrays import FloatArray, IntArray


class Band(NamedTuple):
    """Places of a road's states, and what lies in the band, for compiled code."""

    order: IntArray  # (n_x,) component of the state at each place
    segment: IntArray  # (S,) place of each segment's rho; that of psi follows
    factor: IntArray  # (1 + I,) place of each demand factor, or none
    scale: FloatArray  # (n_x,) units of the normalised components by place
    first: IntArray  # (n_x,) first place in the band of each place
    last: IntArray  # (n_x,) last place in it
    group: IntArray  # (n_x,) group of each place
    start: IntArray  # (G + 1,) first place of each group, and n_x
    reach: int  # H, the largest distance of two places in the band
    step: int  # largest distance of two places of which one affects the other in a step


def make_band(model: ARZModel, band: int) -> Band:
    """Return the places and the band of a road, for a band in segments."""
    places = state_places(model)
    order = in_road_order(places)
    place = np.argsort(order).astype(np.int64)
    x, n = places.position[order], order.size
    is_first = np.diff(places.segment[order], prepend=-1) != 0
    # Positions are multiples of a half.
    first = np.searchsorted(x, x - band - 0.25).astype(np.int64)
    last = np.searchsorted(x, x + band + 0.25).astype(np.int64) - 1
    segment, factor = place[0 : 2 * model.n_segments : 2], place[2 * model.n_segments :]
    reach = int((np.arange(n) - first).max())
    return Band(
        order=order.astype(np.int64),
        segment=segment.astype(np.int64),
        factor=factor.astype(np.int64),
        scale=np.ascontiguousarray(model.state_scale[order]),
        first=first,
        last=last,
        group=(np.cumsum(is_first) - 1).astype(np.int64),
        start=np.append(np.flatnonzero(is_first), n).astype(np.int64),
        reach=reach,
        step=_step(model, segment),
    )


def _step(model: ARZModel, segment: IntArray) -> int:
    """Return how many places away a component affects another one within a step."""
    road = make_road_arrays(model)
    furthest = 2  # a demand factor follows its segment's psi
    for c in range(road.jam.size):
        others = segment[road.neighbours[c, : road.degree[c]]]
        furthest = max(furthest, int(np.abs(others - segment[c]).max()) + 1)
    return furthest


def expanded(band: Band, stored: FloatArray) -> FloatArray:
    """Return covariances `(n, n_x, n_x)` in the order of the state, zero beyond the band."""
    n_episodes, n = stored.shape[:2]
    full = np.zeros((n_episodes, n, n))
    for lag in range(band.reach + 1):
        rows = np.arange(lag, n)
        here, there = band.order[rows], band.order[rows - lag]
        full[:, here, there] = full[:, there, here] = stored[:, rows, band.reach - lag]
    return full
