"""Collected scenarios as tensors."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from agents.filters.collecting import Collected
from agents.filters.torch_network import Road


class Batch(NamedTuple):
    """The seconds 1 to T of n episodes on one road."""

    road: Road
    start: Tensor  # (n, S, 2)
    measured: Tensor  # (T, n, S, 9)
    outside: Tensor  # (T, n, S, 2)
    truth: Tensor  # (T, n, S, 2)


def make_batch(collected: Collected) -> Batch:
    """Return a scenario as tensors."""
    cells, n = collected.cells, len(collected.start)
    S = cells.lanes.size
    upstream = torch.zeros(S, S)
    edges = torch.from_numpy(cells.edges)
    upstream[edges[:, 1], edges[:, 0]] = 1.0
    road = Road(
        unit=torch.from_numpy(cells.unit).float(),
        limit=cells.limit,
        flows=torch.full((n, 1), float(cells.flows)),
        fixed=torch.from_numpy(cells.fixed).float().expand(n, -1, -1),
        upstream=upstream,
        scales=collected.scales,
        n_mainline=collected.n_mainline,
    )
    arrays = (collected.start, collected.measured, collected.outside, collected.truth)
    return Batch(road, *(torch.from_numpy(array) for array in arrays))
