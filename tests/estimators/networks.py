"""Networks with random weights, as files."""

import numpy as np

from dptse_env.estimators import EstimatorSettings, RecurrentSettings
from dptse_env.estimators.recurrent import FORMAT, write_network
from dptse_env.estimators.recurrent_kernels import CHANNELS, Network, shapes

RANGES = {
    "n_mainline": [2, 30],
    "segment_length": [0.05, 0.2],
    "speed_limit": [80.0, 130.0],
    "lanes": [1, 4],
    "span": [1, 3],
    "flows": [0, 1],
}


def random_network(width=8, seed=0):
    """Weights of the size that training gives, so that gates work and outputs move."""
    rng, size = np.random.default_rng(seed), 0.4 * (8 / width) ** 0.5
    arrays = {name: rng.normal(0.0, size, shape) for name, shape in shapes(width).items()}
    return Network(**{name: array.astype(np.float32) for name, array in arrays.items()})


def card(**ranges):
    return {
        "name": "random",
        "format": FORMAT,
        "channels": list(CHANNELS),
        "ranges": {**RANGES, **ranges},
        "training": {"seed": 0},
    }


def settings(folder, network=None, outside=False, **ranges):
    """Settings of a network that is written into a folder."""
    path = folder / "network.safetensors"
    write_network(path, network or random_network(), card(**ranges))
    return EstimatorSettings(recurrent=RecurrentSettings(weights=str(path), outside=outside))
