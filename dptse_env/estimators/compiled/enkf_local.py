"""Compiled update of an ensemble whose covariances a taper confines to stretches of a long road.

The same update as that of `enkf_kernels`, without what the taper makes zero: S is factorised in the
order of the rows along the road, where it is a band; it is solved for the members' residuals
instead of the gain; and a row reaches the states near it. Time grows with the length of the road.
"""

import math
from typing import NamedTuple

import numpy as np

from dptse_env.estimators.localisation import RowTapers, positions
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part


class Near(NamedTuple):
    """What lies within the reach of a taper of the M rows of a measurement."""

    rank: IntArray  # (M,) number of each row along the road
    first: IntArray  # (M,) rank of the first row that the taper lets each row correlate with
    start: IntArray  # (M + 1,) where a row's components begin in `states`
    states: IntArray  # components of the state near each row


def make_near(model: ARZModel, tapers: RowTapers, reach: float) -> Near:
    """Return what a taper leaves, or nothing where it leaves most of the road."""
    network, none = model.network, np.empty(0, dtype=np.int64)
    if 2.0 * reach >= math.fsum(network.segment_lengths[: network.n_mainline]):
        return Near(none, none, none, none)
    order = np.argsort(model.rows.weights @ positions(network), kind="stable")
    rank = np.argsort(order)
    linked = tapers.among_rows[np.ix_(order, order)] > 0.0
    near = [np.flatnonzero(row > 0.0) for row in tapers.with_states]
    return Near(
        rank=rank.astype(np.int64),
        first=linked.argmax(axis=1)[rank].astype(np.int64),
        start=np.cumsum([0, *map(len, near)]).astype(np.int64),
        states=np.concatenate(near).astype(np.int64),
    )


@kernel_part(fastmath={"contract", "reassoc"})
def _product(one: FloatArray, other: FloatArray) -> float:
    total = 0.0
    for j in range(one.size):
        total += one[j] * other[j]
    return total


@kernel_part(kept=True)
def joint_band(
    near: Near,
    among: FloatArray,
    rows: IntArray,
    distances: FloatArray,
    noise: FloatArray,
    inverse: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return S of m measured rows as a band along the road.

    Args:
        near: What lies within the taper's reach.
        among: `(M, M)` weights of covariances among rows.
        rows: `(m,)` that are measured.
        distances: `(2 m, width)` deviations of outputs, two for each row.
        noise: `(2 m,)` deviations of the noise.
        inverse: 1 / (members - 1).

    Returns:
        The outputs in the order of the road `(2 m,)`; for each of these the first one with which
        it is correlated; and S, `(2 m, D + 1)`, row i with the entries from i - D to i.
    """
    ranks, m = near.rank[rows], rows.size
    by_road = np.argsort(ranks)
    outputs, first = np.empty(2 * m, dtype=np.int64), np.empty(2 * m, dtype=np.int64)
    reach, begun = 0, 0
    for i in range(m):
        r = by_road[i]
        outputs[2 * i], outputs[2 * i + 1] = 2 * r, 2 * r + 1
        begun = 0
        while ranks[by_road[begun]] < near.first[rows[r]]:
            begun += 1
        first[2 * i] = first[2 * i + 1] = 2 * begun
        reach = max(reach, 2 * i + 1 - 2 * begun)
    band = np.zeros((2 * m, reach + 1))
    for i in range(2 * m):
        a = outputs[i]
        for j in range(first[i], i + 1):
            b = outputs[j]
            weight = among[rows[a // 2], rows[b // 2]]
            product = _product(distances[a], distances[b]) if weight > 0.0 else 0.0
            band[i, j - i + reach] = inverse * weight * product
        band[i, reach] += noise[a] ** 2
    return outputs, first, band


@kernel_part(fastmath={"contract"})
def solve_band(outputs: IntArray, first: IntArray, band: FloatArray, right: FloatArray) -> bool:
    """Replace rows of `right` by `S^-1 right`, S by its factor; return whether it has one."""
    n, reach = band.shape[0], band.shape[1] - 1
    for i in range(n):
        for k in range(first[i], i + 1):
            start = max(first[i], first[k])
            total = band[i, k - i + reach]
            for j in range(start, k):
                total -= band[i, j - i + reach] * band[k, j - k + reach]
            if k < i:
                band[i, k - i + reach] = total / band[k, reach]
            elif 0.0 < total < np.inf:
                band[i, reach] = np.sqrt(total)
            else:
                return False
    for i in range(n):
        row = right[outputs[i]]
        for k in range(first[i], i):
            factor, other = band[i, k - i + reach], right[outputs[k]]
            for j in range(row.size):
                row[j] -= factor * other[j]
        row /= band[i, reach]
    for i in range(n - 1, -1, -1):
        row = right[outputs[i]]
        row /= band[i, reach]
        for k in range(first[i], i):
            factor, other = band[i, k - i + reach], right[outputs[k]]
            for j in range(row.size):
                other[j] -= factor * row[j]
    return True


@kernel_part(fastmath={"contract"})
def move_members(
    near: Near,
    tapers: FloatArray,
    rows: IntArray,
    distances: FloatArray,
    states: FloatArray,
    solved: FloatArray,
    inverse: float,
    members: FloatArray,
) -> None:
    """Move the members by the gain times residuals, `S^-1` times which is `solved`.

    Args:
        near: What lies within the taper's reach.
        tapers: `(M, n_x)` weights of covariances of rows with states.
        rows: `(m,)` that are measured.
        distances: `(2 m, width)` deviations of outputs.
        states: `(n_x, width)` deviations of states.
        solved: `(2 m, width)`.
        inverse: 1 / (members - 1).
        members: `(n_x, width)`, moved.
    """
    for i in range(rows.size):
        one, other = solved[2 * i], solved[2 * i + 1]
        for place in range(near.start[rows[i]], near.start[rows[i] + 1]):
            k = near.states[place]
            weight = inverse * tapers[rows[i], k]
            a = weight * _product(distances[2 * i], states[k])
            b = weight * _product(distances[2 * i + 1], states[k])
            row = members[k]
            for j in range(row.size):
                row[j] += a * one[j] + b * other[j]
