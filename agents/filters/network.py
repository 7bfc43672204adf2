"""The recurrent network in torch, with gradients, and the loss that it is trained by."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from dptse_env.estimators.recurrent_kernels import (
    DENSITY_RANGE,
    HIGHEST_SPREAD,
    LOWEST_SPREAD,
    SPEED_RANGE,
    Network,
    message_width,
    shapes,
)


class Road(NamedTuple):
    """The cells of a road and their connections, and how errors are measured on it."""

    unit: Tensor  # (S,) of densities [veh/km]
    limit: float  # unit of speeds [km/h]
    upstream: Tensor  # (S, S) flags of the cells (columns) upstream of each
    scales: tuple[float, float]  # of errors of densities [veh/km] and speeds [km/h]
    n_mainline: int


class RecurrentNetwork(nn.Module):
    """The network of `dptse_env.estimators.recurrent_kernels`, with gradients."""

    inputs: Tensor
    inputs_bias: Tensor
    hidden: Tensor
    hidden_bias: Tensor
    heads: Tensor
    heads_bias: Tensor

    def __init__(self, width: int) -> None:
        """Draw orthogonal hidden weights, and inputs' weights by their number."""
        super().__init__()
        self.width = width
        for name, shape in shapes(width).items():
            weights = torch.zeros(shape)
            if name == "inputs":
                weights.uniform_(-1.0, 1.0).mul_(shape[0] ** -0.5)
            elif name == "hidden":
                for first in range(0, 3 * width, width):
                    nn.init.orthogonal_(weights[:, first : first + width])
            elif name == "heads":
                weights.normal_(0.0, 0.1 * width**-0.5)
            self.register_parameter(name, nn.Parameter(weights))
        with torch.no_grad():
            # Free flow, and deviations of some 20 veh/km and 10 km/h.
            self.heads_bias.copy_(torch.tensor([-2.0, 1.5, -2.0, -2.3] * 2))
            # Cells remember for a second, or for as long as a minute.
            self.inputs_bias[:width] = torch.linspace(0.0, 4.0, width)

    def forward(self, road: Road, x: Tensor, h: Tensor) -> Tensor:
        """Return the hidden states after a second.

        Args:
            road: The road.
            x: The channels of every cell, as `recurrent_kernels.read` writes them, shape (k, S, C).
            h: Hidden states before, shape (k, S, H).
        """
        H = self.width
        messages = h[..., : message_width(H)]
        up, down = road.upstream @ messages, road.upstream.T @ messages
        g = torch.cat([x, up, down], -1) @ self.inputs + self.inputs_bias
        q = h @ self.hidden + self.hidden_bias
        gates = torch.sigmoid(g[..., : 2 * H] + q[..., : 2 * H])
        z, r = gates[..., :H], gates[..., H:]
        n = torch.tanh(g[..., 2 * H :] + r * q[..., 2 * H :])
        return n + z * (h - n)

    def read(self, road: Road, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the heads say of hidden states (..., S, H): of this second, and the next.

        Density [veh/km], speed [km/h] and their standard deviations, shape (..., S, 4) each.
        """
        raw = h @ self.heads + self.heads_bias
        return _outputs(road, raw[..., :4]), _outputs(road, raw[..., 4:])

    def take(self, weights: Network) -> None:
        """Take weights of the same width."""
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                parameter.copy_(torch.from_numpy(getattr(weights, name).copy()))

    def weights(self) -> Network:
        """Return the weights as arrays."""
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(parameter.detach().numpy().copy())
            for name, parameter in self.named_parameters()
        }
        return Network(**arrays)


def _outputs(road: Road, raw: Tensor) -> Tensor:
    mean = torch.sigmoid(raw[..., :2])
    spread = torch.exp(torch.clip(raw[..., 2:], LOWEST_SPREAD, HIGHEST_SPREAD))
    parts = [
        DENSITY_RANGE * road.unit * mean[..., 0], SPEED_RANGE * road.limit * mean[..., 1],
        road.unit * spread[..., 0], road.limit * spread[..., 1],
    ]  # fmt: skip
    return torch.stack(parts, -1)


def second_loss(road: Road, estimated: Tensor, truth: Tensor, likelihood: float) -> Tensor:
    """Return the loss of a second, averaged over all leading dimensions.

    The environment's error over the mainline, and `likelihood` times the negative log-likelihood
    of all cells under independent normal distributions. Speeds of empty cells do not count.

    Args:
        road: The road.
        estimated: Shape (..., S, 4).
        truth: Shape (..., S, 2).
        likelihood: Weight of the likelihood.
    """
    scales = torch.tensor(road.scales)
    error, spread = (estimated[..., :2] - truth) / scales, estimated[..., 2:] / scales
    occupied = (truth[..., 0] > 0.0).float()
    counts = torch.stack([torch.ones_like(occupied), occupied], -1)
    squares = error**2 * counts
    n = road.n_mainline
    total = squares[..., :n, :].sum((-1, -2)) / counts[..., :n, :].sum((-1, -2))
    surprise = (torch.log(spread) + 0.5 * (error / spread) ** 2) * counts
    return torch.sqrt(total + 1e-8).mean() + likelihood * surprise.sum() / counts.sum()
