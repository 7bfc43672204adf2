"""Compiled assembly of a window's matrix H in the order of the road.

H is the inverse covariance of a chain of states. Its entries couple a cell with itself, with its
neighbours one step before, and with the neighbours' neighbours at the same time; many of these
vanish, since a flow depends on either demand or supply. All quantities are normalised.
"""

import numpy as np

from dptse_env.estimators.compiled.chain import Chain
from dptse_env.estimators.compiled.envelope import close_envelope
from dptse_env.estimators.compiled.road_order import Order, Space, place
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part


@kernel_part
def assemble(road: RoadArrays, chain: Chain, n_stages: int, order: Order, space: Space) -> None:
    """Write H without the last stage's measurements; `first` and `last` also have room for them."""
    n_variables, last_stage = n_stages * chain.arrival.size, n_stages - 1
    matrix, first = space.matrix[:n_variables], space.first[:n_variables]
    matrix[:] = 0.0
    for i in range(n_variables):
        first[i] = i
    for i in range(chain.arrival.size):
        matrix[place(order, n_stages, 0, i), 0] = 1.0 / chain.arrival_variance[i]
    places = np.empty(3 + 2 * road.neighbours.shape[1], np.int64)
    weights = np.empty((2, places.size))
    for t in range(last_stage):
        for c in range(road.jam.size):
            m = _list_step(road, chain, n_stages, order, t, c, places, weights)
            w_rho = 1.0 / chain.process_variance[t, 2 * c]
            w_psi = 1.0 / chain.process_variance[t, 2 * c + 1]
            for a in range(m):
                x, y = w_rho * weights[0, a], w_psi * weights[1, a]
                for b in range(a, m):
                    value = x * weights[0, b] + y * weights[1, b]
                    _add(matrix, first, places[a], places[b], value)
        for i in range(2 * road.jam.size, chain.arrival.size):
            here, after = place(order, n_stages, t, i), place(order, n_stages, t + 1, i)
            w = 1.0 / chain.process_variance[t, i]
            _add(matrix, first, here, here, w)
            _add(matrix, first, here, after, -w)
            _add(matrix, first, after, after, w)
        add_rows(road, chain, n_stages, order, t, 1.0, matrix, first)
    add_rows(road, chain, n_stages, order, last_stage, 0.0, matrix, first)
    close_envelope(first, space.last[:n_variables])


@kernel_part
def _list_step(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    order: Order,
    t: int,
    c: int,
    places: IntArray,
    weights: FloatArray,
) -> int:
    """List the variables in a cell's two residuals of a step, with their weights; return how many.

    The residuals are those of rho and psi after the step, less what the step predicts.
    """
    places[0] = place(order, n_stages, t + 1, 2 * c)
    places[1] = places[0] + 1
    weights[0, 0], weights[0, 1], weights[1, 0], weights[1, 1] = 1.0, 0.0, 0.0, 1.0
    m = 2
    for slot in range(road.degree[c]):
        block = chain.blocks[t, c, slot]
        if block[0] == 0.0 and block[1] == 0.0 and block[2] == 0.0 and block[3] == 0.0:
            continue
        places[m] = place(order, n_stages, t, 2 * road.neighbours[c, slot])
        places[m + 1] = places[m] + 1
        for j in range(2):
            weights[0, m + j], weights[1, m + j] = -block[j], -block[2 + j]
        m += 2
    e = order.factor[c]
    if e >= 0:
        places[m] = place(order, n_stages, t, 2 * road.jam.size + e)
        weights[0, m], weights[1, m] = -chain.by_factor[t, e, 0], -chain.by_factor[t, e, 1]
        m += 1
    return m


@kernel_part
def _add(matrix: FloatArray, first: IntArray, i: int, j: int, value: float) -> None:
    """Add to entry (i, j) of a symmetric matrix in a band, and make room for it."""
    upper, column = min(i, j), max(i, j)
    matrix[upper, column - upper] += value
    first[column] = min(first[column], upper)


@kernel_part
def add_rows(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    order: Order,
    t: int,
    part: float,
    matrix: FloatArray,
    first: IntArray,
) -> None:
    """Add a part of C'C/R of a stage to H; 0 makes room for it."""
    slopes = chain.slopes[t]
    for m in range(road.row_first.size):
        if not chain.observed[t, m]:
            continue
        start, span = road.row_first[m], road.row_span[m]
        w_density = part / (chain.noise[t, m, 0] * span**2)
        w_second = part / (chain.noise[t, m, 1] * span**2)
        for c in range(start, start + span):
            i, (by_rho, by_psi) = place(order, n_stages, t, 2 * c), slopes[c]
            for d in range(c, start + span):
                j, x, y = place(order, n_stages, t, 2 * d), w_second * by_rho, w_second * by_psi
                _add(matrix, first, i, j, w_density + x * slopes[d, 0])
                _add(matrix, first, i, j + 1, x * slopes[d, 1])
                _add(matrix, first, i + 1, j + 1, y * slopes[d, 1])
                if d > c:
                    _add(matrix, first, i + 1, j, y * slopes[d, 0])
