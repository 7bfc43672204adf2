"""The order along the road of a window's variables, and the space that its algebra needs.

In the order of time a window's matrix fills with numbers as the road becomes long: a state's
covariance has no zeros. Along the road, with a segment's states of all stages side by side, H has
entries near its diagonal only.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from dptse_env.estimators.compiled.envelope import SPARE
from dptse_env.estimators.localisation import positions
from dptse_env.model import ARZModel
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import kernel, kernel_part


class Order(NamedTuple):
    """Places of a window's variables: component i of stage t has `L before + t stride + within`."""

    before: IntArray  # (n_x,) components of segments that lie upstream
    stride: IntArray  # (n_x,) components of the segment, with its demand factor
    within: IntArray  # (n_x,) which of these it is
    factor: IntArray  # (S,) the demand factor of a segment, -1 for none
    width: int  # of a row of H in the longest window, spare numbers included


class Space(NamedTuple):
    """Working space of a window of N = L n_x variables."""

    matrix: FloatArray  # (N, width) H, as in `envelope`
    factor: FloatArray  # (N, width) of H, or of H with some variables fixed
    inverse: FloatArray  # (N, width) entries of the inverse of H
    first: IntArray  # (N,)
    last: IntArray  # (N,)
    diagonal: FloatArray  # (N,) of H
    curvature: FloatArray  # (L, n_x) the same, by stage and component
    free: FloatArray  # (N,) 1, or 0 for variables that are fixed at a bound
    flips: BoolArray  # (N,) which variables are free and were not before, or the other way round
    changed: IntArray  # (N,) the same as a list
    vector: FloatArray  # (N,)
    row: FloatArray  # (width,)


def make_order(model: ARZModel, road: RoadArrays, n_stages: int) -> Order:
    """Return the order along the road of the variables of windows of up to L stages."""
    n = model.n_segments
    factor = np.full(n, -1, dtype=np.int64)
    entries = model.layout.entries[: model.n_demand_states]
    factor[entries] = np.arange(entries.size)
    size = np.where(factor >= 0, 3, 2)
    along = np.argsort(positions(model.network), kind="stable")
    before = np.empty(n, dtype=np.int64)
    before[along] = np.cumsum(size[along]) - size[along]
    segment = np.concatenate([np.repeat(np.arange(n), 2), entries])
    groups = [[c, *road.neighbours[c, 1 : road.degree[c]]] for c in range(n)]
    groups += [
        list(range(i, i + k)) for i, k in zip(model.rows.first, model.rows.span, strict=True)
    ]
    ends = np.array([[before[group].min(), (before + size)[group].max()]
                     for group in groups])  # fmt: skip
    return Order(
        before=before[segment],
        stride=size[segment],
        within=np.concatenate([np.tile([0, 1], n), np.full(entries.size, 2)]),
        factor=factor,
        width=n_stages * int(np.diff(ends).max()) + SPARE,
    )


@kernel
def make_space(order: Order, n_stages: int) -> Space:
    """Allocate the working space of windows of up to L stages."""
    n = n_stages * order.before.size
    return Space(
        np.empty((n, order.width)),
        np.empty((n, order.width)),
        np.empty((n, order.width)),
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
        np.zeros(n),
        np.zeros((n_stages, order.before.size)),
        np.ones(n),
        np.zeros(n, np.bool_),
        np.zeros(n, np.int64),
        np.zeros(n),
        np.zeros(order.width),
    )


class Spaces:
    """Working spaces that are kept from step to step, one for each thread that is in one.

    For a new one the operating system has to clear memory, which took a third of a step on 120
    segments.
    """

    def __init__(self, order: Order, n_stages: int) -> None:
        """Take the order, and the stages of the longest window."""
        self._order, self._n_stages = order, n_stages
        self._idle: list[tuple[AnyArray, ...]] = []

    def __reduce__(self) -> tuple[type[Spaces], tuple[Order, int]]:
        """Copy and pickle without the spaces."""
        return type(self), (self._order, self._n_stages)

    @contextmanager
    def lend(self) -> Iterator[tuple[AnyArray, ...]]:
        """Lend a space, a `Space` as a tuple for kernels."""
        try:
            space = self._idle.pop()
        except IndexError:  # all are lent to other threads
            space = tuple(make_space(self._order, self._n_stages))
        try:
            yield space
        finally:
            self._idle.append(space)


@kernel_part
def place(order: Order, n_stages: int, t: int, i: int) -> int:
    """Return the place of component i of stage t among the variables of a window of L stages."""
    return int(n_stages * order.before[i] + t * order.stride[i] + order.within[i])


@kernel_part
def write_line(order: Order, n_stages: int, table: FloatArray, line: FloatArray) -> None:
    """Write a table by stage and component `(L, padded)` as a line along the road `(N,)`."""
    for t in range(n_stages):
        for i in range(order.before.size):
            line[place(order, n_stages, t, i)] = table[t, i]


@kernel_part
def read_line(order: Order, n_stages: int, line: FloatArray, table: FloatArray) -> None:
    """Write a line along the road `(N,)` as a table by stage and component `(L, padded)`."""
    for t in range(n_stages):
        for i in range(order.before.size):
            table[t, i] = line[place(order, n_stages, t, i)]
