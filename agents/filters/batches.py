"""Collected episodes as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.filters.collecting import Collected, Released, Rows
from agents.filters.torch_network import Road
from dptse_env.traffic.corridor import GEOMETRY
from dptse_env.utils.arrays import IntArray

Picks = Sequence[tuple[Collected, IntArray]]
"""Scenarios on one road, each with the indices of some of its episodes."""


_SAME = (*GEOMETRY, "duration", "density_scale", "speed_scale")
"""Fields of a corridor that the episodes of a batch share."""


class Batch(NamedTuple):
    """The seconds 1 to T of n episodes on one road."""

    road: Road
    start: Tensor  # (n, S, 4)
    released: Released  # with a leading axis of T
    outside: Tensor  # (T, n, S, 2)
    truth: Tensor  # (T, n, S, 2)

    def second(self, t: int) -> Released:
        """Return what is measured in second t + 1."""
        return Released(*(array[t] for array in self.released))


def draw_batch(rng: np.random.Generator, collected: Sequence[Collected], n: int) -> Batch:
    """Return `n` episodes, drawn from all scenarios on the road of one that is drawn first."""
    road = _geometry(collected[int(rng.integers(len(collected)))])
    scenarios = [each for each in collected if _geometry(each) == road]
    ends = np.cumsum([len(each.start) for each in scenarios])
    drawn = np.sort(rng.choice(ends[-1], size=min(n, int(ends[-1])), replace=False))
    owners = np.searchsorted(ends, drawn, side="right")
    picks = [
        (each, drawn[owners == k] - (ends[k] - len(each.start))) for k, each in enumerate(scenarios)
    ]
    return make_batch([(each, chosen) for each, chosen in picks if chosen.size > 0])


def _geometry(collected: Collected) -> list[object]:
    return [getattr(collected.corridor, name) for name in _SAME]


def make_batch(picks: Picks) -> Batch:
    """Return episodes of several scenarios on one road as tensors.

    Rows of measurements that a scenario lacks are padded with rows that cover nothing.
    """
    first, n_rows = picks[0][0], max(each.rows.share.size for each, _ in picks)
    cells, S = first.cells, first.cells.lanes.size
    upstream = torch.zeros(S, S)
    edges = torch.from_numpy(cells.edges)
    upstream[edges[:, 1], edges[:, 0]] = 1.0
    flows = [np.full((len(chosen), 1), float(each.cells.flows)) for each, chosen in picks]
    rows = [
        [np.repeat(_padded(array[None], 1, n_rows), len(chosen), axis=0) for array in each.rows]
        for each, chosen in picks
    ]
    measured = [
        [_padded(array[:, chosen], 2, n_rows) for array in each.released[:3]]
        + [each.released.centre[:, chosen]]
        for each, chosen in picks
    ]
    road = Road(
        unit=torch.from_numpy(cells.unit).float(),
        limit=cells.limit,
        flows=_joined(flows, 0),
        fixed=torch.from_numpy(cells.fixed).float().expand(sum(map(len, flows)), -1, -1),
        rows=Rows(*(_joined(arrays, 0) for arrays in zip(*rows, strict=True))),
        upstream=upstream,
        scales=(first.corridor.density_scale, first.corridor.speed_scale),
        n_mainline=first.corridor.n_mainline,
    )
    return Batch(
        road,
        _joined([each.start[chosen] for each, chosen in picks], 0),
        Released(*(_joined(arrays, 1) for arrays in zip(*measured, strict=True))),
        _joined([each.outside[:, chosen] for each, chosen in picks], 1),
        _joined([each.truth[:, chosen] for each, chosen in picks], 1),
    )


def _joined(arrays: Sequence[NDArray[Any]], axis: int) -> Tensor:
    return torch.from_numpy(np.concatenate(arrays, axis=axis)).float()


def _padded(array: NDArray[Any], axis: int, size: int) -> NDArray[Any]:
    widths = [(0, 0)] * array.ndim
    widths[axis] = (0, size - array.shape[axis])
    return np.pad(array, widths)
