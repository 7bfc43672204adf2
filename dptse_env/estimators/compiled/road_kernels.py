"""Compiled kernels of the moving horizon estimator for long roads.

The algebra of a window is that of its matrix H in the order of the road. The covariances of the
last state are entries of its inverse; those near its diagonal, which a step needs, take a time in
proportion to the road, and the others are computed where they are asked for.
"""

import numpy as np

from dptse_env.estimators.compiled.chain import Chain
from dptse_env.estimators.compiled.ekf_kernels import Filters, Packed
from dptse_env.estimators.compiled.envelope import factorise, invert, solve_many
from dptse_env.estimators.compiled.mhe_kernels import (
    accept,
    enter_measurements,
    innovate,
    restart,
    write_sides,
)
from dptse_env.estimators.compiled.road_matrix import add_rows, assemble
from dptse_env.estimators.compiled.road_order import Order, Space, place
from dptse_env.estimators.compiled.road_program import minimise
from dptse_env.estimators.compiled.stages import UNSOLVED, Windows, chain_of
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import any_of
from dptse_env.utils.kernels import kernel, kernel_part


@kernel
def update(
    road_: Packed,
    filters_: Packed,
    windows_: Packed,
    order_: Packed,
    space_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> None:
    """Update by measurements, `sigma` no less than allowed; see `Estimator.update`."""
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    order, space = Order(*order_), Space(*space_)
    for k in range(episodes.size):
        e = episodes[k]
        sound = enter_measurements(
            road, filters, windows, e, observed[k], values[k], sigma[k], centre[k]
        )
        chain = chain_of(windows, e)
        sound = sound and _spread(road, filters, windows, order, e, chain, space)
        if sound and any_of(observed[k]):
            _solve(road, filters, windows, order, e, chain, space)
        filters.diverged[e] = not sound
        if not sound:
            restart(filters_, windows_, e)


@kernel
def solve(
    road_: Packed,
    filters_: Packed,
    windows_: Packed,
    order_: Packed,
    space_: Packed,
    episodes: IntArray,
) -> None:
    """Solve the programs of episodes whose windows have been linearised."""
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    order, space = Order(*order_), Space(*space_)
    for k in range(episodes.size):
        e = episodes[k]
        chain = chain_of(windows, e)
        if _assemble(road, chain, windows.length[e], order, space):
            _solve(road, filters, windows, order, e, chain, space)


@kernel_part
def _assemble(road: RoadArrays, chain: Chain, n_stages: int, order: Order, space: Space) -> bool:
    """Write H and its factor; return whether it has one."""
    assemble(road, chain, n_stages, order, space)
    first = space.first[: n_stages * chain.arrival.size]
    add_rows(road, chain, n_stages, order, n_stages - 1, 1.0, space.matrix, first)
    return factorise(space.matrix, first, space.last, space.factor)


@kernel_part
def _solve(
    road: RoadArrays,
    filters: Filters,
    windows: Windows,
    order: Order,
    e: int,
    chain: Chain,
    space: Space,
) -> None:
    """Solve a program and accept the solution, if there is one; `space` has H and its factor."""
    z = windows.solution[e].copy()
    rounds = minimise(road, chain, windows.length[e], order, space, windows.lower, windows.upper, z)
    windows.rounds[e] = rounds
    if rounds != UNSOLVED:
        write_sides(windows, e, z)
        accept(road, filters, windows, e, z)


@kernel_part
def _spread(
    road: RoadArrays,
    filters: Filters,
    windows: Windows,
    order: Order,
    e: int,
    chain: Chain,
    space: Space,
) -> bool:
    """Factorise H; write innovations and variances; return whether all is sound.

    The covariances of segments with one another are written by `write_covariance`.
    """
    length = windows.length[e]
    windows.updated[e] = length
    n_variables, last = length * windows.units.size, length - 1
    matrix, first, factor = space.matrix, space.first[:n_variables], space.factor
    assemble(road, chain, length, order, space)
    if not factorise(matrix, first, space.last, factor):
        return False
    invert(factor, space.last[:n_variables], space.inverse, space.row)
    for m in range(road.row_first.size):
        if windows.observed[e, last, m]:
            for s in range(road.row_first[m], road.row_first[m] + road.row_span[m]):
                for c in range(road.row_first[m], s + 1):
                    _copy_block(order, length, space.inverse, s, c, filters.covariances[e])
    innovate(road, filters, windows, e, filters.covariances[e])
    add_rows(road, chain, length, order, last, 1.0, matrix, first)
    if not factorise(matrix, first, space.last, factor):
        return False
    invert(factor, space.last[:n_variables], space.inverse, space.row)
    total = 0.0
    for s in range(road.jam.size):
        _copy_block(order, length, space.inverse, s, s, filters.covariances[e])
        for i in range(2 * s, 2 * s + 2):
            total += filters.covariances[e, i, i]
    return bool(np.isfinite(total))


@kernel_part
def _copy_block(
    order: Order, length: int, inverse: FloatArray, s: int, c: int, covariance: FloatArray
) -> None:
    """Copy the covariances of two segments at the last stage."""
    for i in range(2 * s, 2 * s + 2):
        for j in range(2 * c, 2 * c + 2):
            p, q = place(order, length, length - 1, i), place(order, length, length - 1, j)
            covariance[i, j] = covariance[j, i] = inverse[min(p, q), abs(p - q)]


@kernel
def write_covariance(
    road_: Packed, filters_: Packed, windows_: Packed, order_: Packed, space_: Packed, e: int
) -> None:
    """Write the covariance of the last state given the window of the last update, without bounds.

    A step needs the variances alone, so this is done where it is asked for.
    """
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    order, chain, length = Order(*order_), chain_of(windows, e), windows.updated[e]
    n, n_variables, space = windows.units.size, length * windows.units.size, Space(*space_)
    windows.updated[e] = 0
    if not _assemble(road, chain, length, order, space):
        return  # not after an update that was sound
    columns, covariance = np.zeros((n_variables, n)), filters.covariances[e]
    for i in range(n):
        columns[place(order, length, length - 1, i), i] = 1.0
    solve_many(space.factor, space.last, columns)
    for i in range(n):
        p = place(order, length, length - 1, i)
        for j in range(i + 1):
            covariance[i, j] = covariance[j, i] = columns[p, j]
