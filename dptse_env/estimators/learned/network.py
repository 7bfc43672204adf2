"""The weights of a recurrent network, and one step of it in numpy.

A gated recurrent unit (Cho et al., 2014) in every cell of a road, with the same weights, reads the
cell's channels x and the sums u and d of the messages of the cells upstream and downstream: the
first 16 numbers of their hidden states.

    z = sigma(W_z [x, u, d] + b_z + V_z h + c_z)
    r = sigma(W_r [x, u, d] + b_r + V_r h + c_r)
    n = tanh(W_n [x, u, d] + b_n + r * (V_n h + c_n))
    h <- z * h + (1 - z) * n

Eight linear heads read h: density, speed and the logarithms of their deviations, for this second
and for the next one before its release.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators.learned.cells import DENSITY_RANGE, SPEED_RANGE
from dptse_env.estimators.learned.channels import CHANNELS

Float32Array = NDArray[np.float32]

N_HEADS = 8
MESSAGE = 16
"""Numbers of a hidden state that the cells next to it read, or all where there are fewer."""
LOWEST_SPREAD, HIGHEST_SPREAD = -7.0, 0.5
"""Range of the logarithms of reported deviations, in units of density and of the speed limit."""


class Network(NamedTuple):
    """Weights of a network of width H with C channels and messages of M numbers, float32."""

    inputs: Float32Array  # W, (C + 2 M, 3 H)
    inputs_bias: Float32Array  # b, (3 H,)
    hidden: Float32Array  # V, (H, 3 H)
    hidden_bias: Float32Array  # c, (3 H,)
    heads: Float32Array  # (H, 8)
    heads_bias: Float32Array  # (8,)

    @property
    def width(self) -> int:
        """Width H of the hidden state."""
        return len(self.hidden)


def message_width(width: int) -> int:
    """Return the numbers M of a message in a network of some width."""
    return min(width, MESSAGE)


def shapes(width: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of a network by name."""
    n_inputs = len(CHANNELS) + 2 * message_width(width)
    return {
        "inputs": (n_inputs, 3 * width),
        "inputs_bias": (3 * width,),
        "hidden": (width, 3 * width),
        "hidden_bias": (3 * width,),
        "heads": (width, N_HEADS),
        "heads_bias": (N_HEADS,),
    }


def advance(network: Network, edges: Any, x: Float32Array, h: Float32Array) -> Float32Array:
    """Return the hidden states (k, S, H) after a step.

    Args:
        network: The weights.
        edges: Cells (from, to) between which vehicles pass, shape (E, 2).
        x: Channels, shape (k, S, C).
        h: Hidden states before, shape (k, S, H).
    """
    H = network.width
    messages = h[..., : message_width(H)]
    upstream, downstream = np.zeros_like(messages), np.zeros_like(messages)
    for start, end in edges:
        upstream[:, end] += messages[:, start]
        downstream[:, start] += messages[:, end]
    read = np.concatenate([x, upstream, downstream], axis=-1)
    g = read @ network.inputs + network.inputs_bias
    q = h @ network.hidden + network.hidden_bias
    z, r = _sigmoid(g[..., :H] + q[..., :H]), _sigmoid(g[..., H : 2 * H] + q[..., H : 2 * H])
    n = np.tanh(g[..., 2 * H :] + r * q[..., 2 * H :])
    after: Float32Array = z * h + (1.0 - z) * n
    return after


def outputs(
    network: Network, unit: Any, limit: float, h: Float32Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what the heads say of this second and of the next, shape (k, S, 4) each.

    Density [veh/km], speed [km/h] and their standard deviations.

    Args:
        network: The weights.
        unit: Unit of densities of each cell [veh/km], shape (S,).
        limit: Speed limit [km/h].
        h: Hidden states, shape (k, S, H).
    """
    raw = h @ network.heads + network.heads_bias
    table = np.empty_like(raw)
    for first in (0, 4):
        table[..., first] = DENSITY_RANGE * unit * _sigmoid(raw[..., first])
        table[..., first + 1] = SPEED_RANGE * limit * _sigmoid(raw[..., first + 1])
        spread = np.exp(np.clip(raw[..., first + 2 : first + 4], LOWEST_SPREAD, HIGHEST_SPREAD))
        table[..., first + 2] = unit * spread[..., 0]
        table[..., first + 3] = limit * spread[..., 1]
    return table[..., :4], table[..., 4:]


def _sigmoid(x: Any) -> Any:
    return 0.5 * (1.0 + np.tanh(0.5 * x))
