"""The recurrent network in torch, and the loss that it is trained on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from dptse_env.estimators.recurrent_kernels import (
    DENSITY_RANGE,
    HIGHEST_SPREAD,
    LOWEST_SPREAD,
    Weights,
    message_width,
    shapes,
)


class Roads(NamedTuple):
    """The cells of k episodes in a row, on any roads, with the units of their errors."""

    unit: Tensor  # (C,) of densities [veh/km]
    speed_unit: Tensor  # (C,) of speeds [km/h]
    fastest: Tensor  # (C,) largest speeds that are estimated [km/h]
    edges: Tensor  # (E, 2) cells (from, to) between which vehicles pass
    scales: Tensor  # (C, 2) of errors of densities [veh/km] and speeds [km/h]
    mainline: Tensor  # (C,) flags
    episode: Tensor  # (C,) index of the episode
    taught: Tensor  # (k,) flags of the episodes that a teacher knows
    n_episodes: int

    def per_episode(self, values: Tensor) -> Tensor:
        """Return sums over the cells of each episode: (..., C) to (..., k)."""
        sums = values.new_zeros(*values.shape[:-1], self.n_episodes)
        return sums.index_add(-1, self.episode, values)


class RecurrentNetwork(nn.Module):
    """The network of `dptse_env.estimators.recurrent_kernels` as a torch module."""

    inputs: Tensor
    inputs_bias: Tensor
    hidden: Tensor
    hidden_bias: Tensor
    heads: Tensor
    heads_bias: Tensor

    def __init__(self, width: int) -> None:
        """Draw hidden weights as orthogonal matrices, the others at random."""
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

    def forward(self, roads: Roads, x: Tensor, h: Tensor) -> Tensor:
        """Return the hidden states after a second.

        Args:
            roads: The cells.
            x: Their features, as `recurrent_kernels.read` writes them, shape (C, N_FEATURES).
            h: Hidden states before that second, shape (C, H).
        """
        H = self.width
        messages = h[..., : message_width(H)]
        start, end = roads.edges.unbind(-1)
        none = torch.zeros_like(messages)
        up = none.index_add(0, end, messages[start])
        down = none.index_add(0, start, messages[end])
        g = torch.cat([x, up, down], -1) @ self.inputs + self.inputs_bias
        q = h @ self.hidden + self.hidden_bias
        gates = torch.sigmoid(g[..., : 2 * H] + q[..., : 2 * H])
        z, r = gates[..., :H], gates[..., H:]
        n = torch.tanh(g[..., 2 * H :] + r * q[..., 2 * H :])
        return n + z * (h - n)

    def read(self, roads: Roads, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return the estimates of hidden states (..., C, H), for this second and for the next.

        Density [veh/km], speed [km/h] and their standard deviations, shape (..., C, 4) each.
        """
        raw = h @ self.heads + self.heads_bias
        return _outputs(roads, raw[..., :4]), _outputs(roads, raw[..., 4:])

    def take(self, weights: Weights) -> None:
        """Take weights of the same width."""
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                parameter.copy_(torch.from_numpy(getattr(weights, name).copy()))

    def weights(self) -> Weights:
        """Return the weights as arrays."""
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(parameter.detach().numpy().copy())
            for name, parameter in self.named_parameters()
        }
        return Weights(**arrays)


def _outputs(roads: Roads, raw: Tensor) -> Tensor:
    mean = torch.sigmoid(raw[..., :2])
    spread = torch.exp(torch.clip(raw[..., 2:], LOWEST_SPREAD, HIGHEST_SPREAD))
    parts = [
        DENSITY_RANGE * roads.unit * mean[..., 0], roads.fastest * mean[..., 1],
        roads.unit * spread[..., 0], roads.speed_unit * spread[..., 1],
    ]  # fmt: skip
    return torch.stack(parts, -1)


def second_loss(
    roads: Roads,
    estimated: Tensor,
    truth: Tensor,
    likelihood: float,
    weight: Tensor | None = None,
) -> Tensor:
    """Return the loss of a second, averaged over episodes and all leading dimensions.

    The environment's error over the mainline, and `likelihood` times the negative log-likelihood
    of all cells under independent normal distributions. Speeds of empty cells do not count.

    Args:
        roads: The cells.
        estimated: Shape (..., C, 4).
        truth: Shape (..., C, 2).
        likelihood: Weight of the likelihood.
        weight: Weights of the episodes, shape (k,); 1 if None.
    """
    error = (estimated[..., :2] - truth) / roads.scales
    spread = estimated[..., 2:] / roads.scales
    occupied = (truth[..., 0] > 0.0).float()
    counts = torch.stack([torch.ones_like(occupied), occupied], -1)
    mainline = roads.mainline[:, None] * counts
    total = roads.per_episode((error**2 * mainline).sum(-1))
    mean = total / roads.per_episode(mainline.sum(-1))
    surprise = (torch.log(spread) + 0.5 * (error / spread) ** 2) * counts
    each = roads.per_episode(surprise.sum(-1)) / roads.per_episode(counts.sum(-1))
    loss = torch.sqrt(mean + 1e-8) + likelihood * each
    return loss.mean() if weight is None else (loss * weight).mean()


def teacher_loss(roads: Roads, estimated: Tensor, taught: Tensor) -> Tensor:
    """Return the distance of estimates from those of a teacher, averaged over all cells.

    Ten times the squared difference of means, in units of errors, plus 0.03 times that of the
    logarithms of deviations. Both arguments have shape (..., C, 4).
    """
    means = (estimated[..., :2] - taught[..., :2]) / roads.scales
    spreads = torch.log(estimated[..., 2:] / taught[..., 2:])
    return 10.0 * (means**2).sum(-1).mean() + 0.03 * (spreads**2).sum(-1).mean()
