"""A linearised window as arrays, with the working space of its algebra."""

from typing import NamedTuple

import numpy as np

from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part


class Chain(NamedTuple):
    """A linearised window of L stages, normalised, with E demand factors or none."""

    arrival: FloatArray  # (n_x,) mean of the first state
    arrival_variance: FloatArray  # (n_x,)
    process_variance: FloatArray  # (>= L - 1, n_x) of the transitions
    blocks: FloatArray  # (>= L - 1, S, K, 4) of the transitions
    by_factor: FloatArray  # (>= L - 1, E, 2) derivatives of the entries' cells by their factors
    offsets: FloatArray  # (>= L - 1, n_x)
    observed: BoolArray  # (>= L, M)
    # (>= L, S, 2) derivatives of each segment's second number, speed or flow, by its rho and psi
    slopes: FloatArray
    constants: FloatArray  # (>= L, S) constants of the linearised second numbers
    values: FloatArray  # (>= L, M, 2) density, and speed or flow, averages over a row's segments
    noise: FloatArray  # (>= L, M, 2) variances


class WindowScratch(NamedTuple):
    """Scratch space for windows of up to L stages."""

    factors: FloatArray  # (L, n_x, padded) filtered covariances
    before: FloatArray  # (n_x, padded) the last covariance before its stage's measurements
    # (L, S, 3) C' C / R of the rows of single segments: rho rho, rho psi, psi psi
    information: FloatArray
    wide: IntArray  # (L, M) the observed rows of several segments
    n_wide: IntArray  # (L,) how many there are
    diagonal: FloatArray  # (L, padded) of H
    product: FloatArray  # (2, n_x, padded) scratch
    sweep: FloatArray  # (4, padded) scratch


@kernel_part
def make_window_scratch(
    road: RoadArrays, n_stages: int, n_states: int, width: int
) -> WindowScratch:
    """Allocate the scratch space."""
    return WindowScratch(
        np.zeros((n_stages, n_states, width)),
        np.zeros((n_states, width)),
        np.zeros((n_stages, road.jam.size, 3)),
        np.zeros((n_stages, road.row_first.size), np.int64),
        np.zeros(n_stages, np.int64),
        np.ones((n_stages, width)),
        np.zeros((2, n_states, width)),
        np.zeros((4, width)),
    )
