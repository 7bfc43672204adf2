"""The recurrent network in torch, and the loss that it is trained by."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from agents.filters.collecting import Released, Rows
from dptse_env.estimators.recurrent_kernels import (
    DENSITY_RANGE,
    HIGHEST_SPREAD,
    LARGEST_CORRECTION,
    LARGEST_INNOVATION,
    LARGEST_SIGMA,
    LEAST_SIGMA,
    LEAST_VARIANCE,
    LONGEST_AGE,
    LOWEST_SPREAD,
    SPEED_RANGE,
    Network,
    message_width,
    shapes,
)


class Road(NamedTuple):
    """The cells of a batch of episodes, as `read_rows` takes them, and their connections."""

    unit: Tensor  # (S,)
    limit: float
    flows: Tensor  # (k, 1)
    fixed: Tensor  # (k, S, N_FIXED)
    rows: Rows  # with a leading axis of k
    upstream: Tensor  # (S, S) flags of the cells (columns) upstream of each
    scales: tuple[float, float]
    n_mainline: int


class State(NamedTuple):
    """State of the network between seconds, for k episodes."""

    hidden: Tensor  # (k, S, H)
    predicted: Tensor  # (k, S, 4), without gradients
    age: Tensor  # (k, S)


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

    def begin(self, start: Tensor) -> State:
        """Return the state before the first second, of a prior (k, S, 4)."""
        k, S = start.shape[:2]
        return State(torch.zeros(k, S, self.width), start, torch.full((k, S), LONGEST_AGE))

    def forward(self, road: Road, released: Released, outside: Tensor, state: State) -> State:
        """Return the state after a second, of its measurements and the inputs (k, S, 2)."""
        with torch.no_grad():
            x, _ = read_rows(road, road.rows, released, state.predicted, state.age)
            age = (state.age + 1.0) * (1.0 - x[..., 0])
            x = torch.cat([x, outside, road.fixed], -1)
        h, H = state.hidden, self.width
        messages = h[..., : message_width(H)]
        up, down = road.upstream @ messages, road.upstream.T @ messages
        g = torch.cat([x, up, down], -1) @ self.inputs + self.inputs_bias
        q = h @ self.hidden + self.hidden_bias
        gates = torch.sigmoid(g[..., : 2 * H] + q[..., : 2 * H])
        z, r = gates[..., :H], gates[..., H:]
        n = torch.tanh(g[..., 2 * H :] + r * q[..., 2 * H :])
        h = n + z * (h - n)
        with torch.no_grad():
            predicted = self._outputs(road, h @ self.heads[:, 4:] + self.heads_bias[4:])
        return State(h, predicted, age)

    def read(self, road: Road, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the heads say of hidden states (..., S, H): of this second, and the next.

        Density [veh/km], speed [km/h] and their standard deviations, shape (..., S, 4) each.
        """
        raw = h @ self.heads + self.heads_bias
        return self._outputs(road, raw[..., :4]), self._outputs(road, raw[..., 4:])

    def _outputs(self, road: Road, raw: Tensor) -> Tensor:
        mean = torch.sigmoid(raw[..., :2])
        spread = torch.exp(torch.clip(raw[..., 2:], LOWEST_SPREAD, HIGHEST_SPREAD))
        parts = [
            DENSITY_RANGE * road.unit * mean[..., 0], SPEED_RANGE * road.limit * mean[..., 1],
            road.unit * spread[..., 0], road.limit * spread[..., 1],
        ]  # fmt: skip
        return torch.stack(parts, -1)

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


def read_rows(
    cells: Any, rows: Rows, released: Released, predicted: Tensor, age: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the channels that come of releases, (k, S, 18), and the innovations (k, M, 2).

    The equations are those of `dptse_env.estimators.recurrent_kernels`, over batches of roads.

    Args:
        cells: Has ``unit`` (S,), ``limit`` and ``flows`` (1 or 0, or (k, 1) of them).
        rows: The rows of the measurement.
        released: The measurement.
        predicted: Predicted density [veh/km], speed [km/h] and their deviations, shape (k, S, 4).
        age: Seconds since the last measurement before this one, shape (k, S).
    """
    flows, unit, limit = cells.flows, cells.unit, cells.limit
    density, speed = predicted[..., 0], predicted[..., 1]
    density_variance, speed_variance = predicted[..., 2] ** 2, predicted[..., 3] ** 2
    slip = flows * (speed - released.centre)  # derivative of y by the density
    by_speed = flows * density + (1.0 - flows)  # derivative of y by the speed
    second = flows * density * slip + (1.0 - flows) * speed
    second_variance = by_speed**2 * speed_variance + slip**2 * density_variance
    innovations, sums = _weigh(
        rows, released, [density, second], [density_variance, second_variance]
    )
    count = sums[..., 0]
    queried, each = torch.clip(count, None, 1.0), 1.0 / torch.clip(count, 1.0, None)
    log_unit = torch.log(unit)
    table = [
        queried,
        sums[..., 1],
        0.2 * (sums[..., 2] * each - queried * log_unit),
        0.2 * (sums[..., 3] * each - queried * (flows * log_unit + math.log(limit))),
        density / unit,
        speed / limit,
        0.25 * torch.log(predicted[..., 2] / unit),
        0.25 * torch.log(predicted[..., 3] / limit),
        0.5 * _held(sums[..., 4], LARGEST_INNOVATION),
        0.5 * _held(sums[..., 5], LARGEST_INNOVATION),
        4.0 * _held(density_variance * sums[..., 6] / unit, LARGEST_CORRECTION),
        4.0 * _held(slip * density_variance * sums[..., 7] / unit, LARGEST_CORRECTION),
        4.0 * _held(by_speed * speed_variance * sums[..., 7] / limit, LARGEST_CORRECTION),
        torch.clip(density_variance * sums[..., 8], None, 1.0),
        torch.clip(by_speed**2 * speed_variance * sums[..., 9], None, 1.0),
        slip / limit,
        queried * 0.0 + flows,
        0.25 * torch.log(1.0 + torch.clip(age, 0.0, LONGEST_AGE)),
    ]
    return torch.stack(table, -1), innovations


def _weigh(
    rows: Rows, released: Released, values: list[Tensor], variances: list[Tensor]
) -> tuple[Tensor, Tensor]:
    """Return innovations over their deviations (k, M, 2), and sums over rows for each cell.

    The sums (k, S, 10) are over the rows that cover a cell: their number, their shares, logarithms
    of sigma, innovations, then e_m / (span_m V_m) and 1 / (span_m^2 V_m); the last four have a
    column for densities and one for the second number.
    """
    observed, share = released.observed, rows.share
    means = _sums(rows.covers, values) * share[..., None]
    total = _sums(rows.covers, variances) * share[..., None] ** 2 + released.sigma**2
    total = torch.clip(total, LEAST_VARIANCE, None)
    errors = observed[..., None] * (released.values - means)
    innovations = errors / torch.sqrt(total)
    weights = (observed * share)[..., None] / total
    sigma = observed[..., None] * torch.log(torch.clip(released.sigma, LEAST_SIGMA, LARGEST_SIGMA))
    tables = [sigma, innovations, weights * errors, share[..., None] * weights]
    columns = [table[..., j] for table in tables for j in range(2)]
    back = torch.swapaxes(rows.covers, -1, -2)
    return innovations, _sums(back, [observed, observed * share, *columns])


def _sums(weights: Tensor, columns: list[Tensor]) -> Tensor:
    return torch.matmul(weights, torch.stack(columns, -1))


def _held(values: Tensor, largest: float) -> Tensor:
    return torch.clip(values, -largest, largest)


def second_loss(road: Road, estimated: Tensor, truth: Tensor, likelihood: float) -> Tensor:
    """Return the loss of a second, averaged over all leading dimensions.

    The environment's error over the mainline, and `likelihood` times the negative log-likelihood
    of all cells under independent normal distributions. Speeds of empty cells do not count.

    Args:
        road: The cells.
        estimated: Shape (..., S, 4).
        truth: Shape (..., S, 2).
        likelihood: Weight of the likelihood.
    """
    error, spread = _scaled(road, estimated, truth)
    occupied = (truth[..., 0] > 0.0).float()
    counts = torch.stack([torch.ones_like(occupied), occupied], -1)
    squares = error**2 * counts
    n = road.n_mainline
    total = squares[..., :n, :].sum((-1, -2)) / counts[..., :n, :].sum((-1, -2))
    surprise = (torch.log(spread) + 0.5 * (error / spread) ** 2) * counts
    return torch.sqrt(total + 1e-8).mean() + likelihood * surprise.sum() / counts.sum()


def _scaled(road: Road, estimated: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return errors and deviations in the units of the environment's error, shape (..., S, 2)."""
    scales = torch.tensor(road.scales)
    return (estimated[..., :2] - truth) / scales, estimated[..., 2:] / scales
