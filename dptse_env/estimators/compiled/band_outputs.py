"""Compiled joint covariance of a state and what its segments release, in a band along the road.

A measured row has averages of densities, which are part of the state, and of second numbers, speeds
or flows. Those of the measured segments join the state, each after the psi of its segment.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.compiled.band import Band
from dptse_env.estimators.compiled.band_algebra import (
    LARGEST_GROUP,
    block_roots,
    cut,
    lost_beyond,
)
from dptse_env.estimators.compiled.band_points import (
    add_lost_surplus,
    add_surplus,
    distances_at,
    moments,
    n_columns,
)
from dptse_env.estimators.compiled.sigma_points import Points
from dptse_env.model.columns import released_by_states
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part


class Joint(NamedTuple):
    """A joint state of N components in the order of the road, and its band."""

    base: IntArray  # (N,) place in the state: a component's, or for an output that of its psi
    state: IntArray  # (n_x,) number of each component of the state, by place
    output: IntArray  # (S,) number of each segment's output, -1 where it is not measured
    first: IntArray  # (N,) first number in the band of each number
    last: IntArray  # (N,) last number in it
    group: IntArray  # (N,) group of each number
    start: IntArray  # (G + 1,) first number of each group, and N
    covariance: FloatArray  # (N, H' + 1)
    centre: FloatArray  # (S,) means of the outputs, where they are measured


@kernel_part
def join(road: RoadArrays, band: Band, observed: BoolArray) -> Joint:
    """Return the joint state of the observed rows, its covariance still to be written."""
    n, n_segments = band.order.size, road.jam.size
    psi = np.full(n, -1)  # the segment whose psi lies at a place, if its output is measured
    n_outputs = 0
    for m in range(observed.size):
        for s in range(road.row_first[m], road.row_first[m] + road.row_span[m]):
            if observed[m] and psi[band.segment[s] + 1] < 0:
                psi[band.segment[s] + 1] = s
                n_outputs += 1
    base, state = np.empty(n + n_outputs, dtype=np.int64), np.empty(n, dtype=np.int64)
    output, k = np.full(n_segments, -1), 0
    for p in range(n):
        base[k], state[p] = p, k
        k += 1
        if psi[p] >= 0:
            base[k], output[psi[p]] = p, k
            k += 1
    first, last = np.empty_like(base), np.empty_like(base)
    group, start, reach = band.group[base], np.empty_like(band.start), 0
    start[-1] = base.size
    for a in range(start.size - 1):
        start[a] = state[band.start[a]]
    for k in range(base.size):
        first[k] = state[band.first[base[k]]]
        end = band.last[base[k]] + 1
        last[k] = state[end] - 1 if end < n else base.size - 1
        reach = max(reach, k - first[k])
    covariance = np.zeros((base.size, reach + 1))
    means = np.zeros(n_segments)
    return Joint(base, state, output, first, last, group, start, covariance, means)


@kernel_part
def gather(
    road: RoadArrays,
    points: Points,
    band: Band,
    e: int,
    centre: FloatArray,
    joint: Joint,
) -> None:
    """Write the covariance of an episode's points and their outputs, and the means of these."""
    n, unit = joint.base.size, road.second_scale
    # An output for every two components, and groups as a whole.
    furthest = 3 * (band.reach + 2 * band.step) // 2 + 2 * LARGEST_GROUP
    distances, wide = np.empty((n, 2 * n_columns(band))), np.empty((n, furthest + 1))
    shift, states = np.empty(n), points.states[e]
    released = np.empty(states.shape[1])
    for p in range(band.order.size):
        k, row = joint.state[p], states[band.order[p]]
        shift[k] = distances_at(band, p, row, band.scale[p], points.weight, distances[k])
        points.centres[e, band.order[p]] = row[0] + shift[k] * band.scale[p]
    for s in range(joint.output.size):
        k = joint.output[s]
        if k >= 0:
            released_by_states(road, s, states[2 * s], states[2 * s + 1], centre[s], released)
            shift[k] = distances_at(
                band, joint.base[k], released, unit, points.weight, distances[k]
            )
            joint.centre[s] = released[0] + shift[k] * unit
    moments(joint.base, distances, points.weight, wide)
    add_surplus(shift, points.surplus, wide)
    roots = block_roots(wide, joint.start)
    lost = lost_beyond(joint.first, joint.group, joint.start, wide, roots)
    add_lost_surplus(joint.start, shift, points.surplus, roots, furthest, lost)
    cut(joint.first, joint.group, wide, lost, joint.covariance)
