"""Contributions of the rows of a window's measurements to its H and its gradient.

A row of one segment adds a 2 x 2 block to H, which is kept per segment. A row of several segments
adds a block that couples all of them; it is applied as a product of vectors instead.
"""

from dptse_env.estimators.compiled.chain import Chain, WindowScratch
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernel_loops import copy_vector
from dptse_env.utils.kernels import kernel_part


@kernel_part(kept=True)
def inform(road: RoadArrays, chain: Chain, n_stages: int, scratch: WindowScratch) -> None:
    """Write the information of single segments, and list the rows of several segments."""
    for t in range(n_stages):
        information, n_wide = scratch.information[t], 0
        information[:] = 0.0
        for m in range(road.row_first.size):
            if not chain.observed[t, m]:
                continue
            if road.row_span[m] > 1:
                scratch.wide[t, n_wide] = m
                n_wide += 1
                continue
            s = road.row_first[m]
            by_rho, by_psi = chain.slopes[t, s, 0], chain.slopes[t, s, 1]
            w_density, w_second = 1.0 / chain.noise[t, m, 0], 1.0 / chain.noise[t, m, 1]
            information[s, 0] += w_density + w_second * by_rho * by_rho
            information[s, 1] += w_second * by_rho * by_psi
            information[s, 2] += w_second * by_psi * by_psi
        scratch.n_wide[t] = n_wide


@kernel_part
def add_diagonal(road: RoadArrays, chain: Chain, n_stages: int, scratch: WindowScratch) -> None:
    """Add the diagonal of C'C/R to that of H."""
    for t in range(n_stages):
        diagonal, information = scratch.diagonal[t], scratch.information[t]
        for s in range(road.jam.size):
            diagonal[2 * s] += information[s, 0]
            diagonal[2 * s + 1] += information[s, 2]
        for i in range(scratch.n_wide[t]):
            m = scratch.wide[t, i]
            first, span = road.row_first[m], road.row_span[m]
            w_density, w_second = 1.0 / chain.noise[t, m, 0], 1.0 / chain.noise[t, m, 1]
            for s in range(first, first + span):
                by_rho, by_psi = chain.slopes[t, s, 0], chain.slopes[t, s, 1]
                diagonal[2 * s] += (w_density + w_second * by_rho**2) / span**2
                diagonal[2 * s + 1] += w_second * by_psi**2 / span**2


@kernel_part
def weigh(information: FloatArray, x: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write right - C'C/R x of a stage, C the rows of single segments."""
    copy_vector(right, out)
    for s in range(information.shape[0]):
        a, b, c = information[s]
        out[2 * s] -= a * x[2 * s] + b * x[2 * s + 1]
        out[2 * s + 1] -= b * x[2 * s] + c * x[2 * s + 1]


@kernel_part
def weigh_wide(
    road: RoadArrays,
    chain: Chain,
    t: int,
    scratch: WindowScratch,
    x: FloatArray,
    out: FloatArray,
) -> None:
    """Subtract C'C/R x of a stage from `out`, C the rows of several segments."""
    slopes = chain.slopes[t]
    for i in range(scratch.n_wide[t]):
        m = scratch.wide[t, i]
        first, span = road.row_first[m], road.row_span[m]
        density, second = 0.0, 0.0
        for s in range(first, first + span):
            density += x[2 * s]
            second += slopes[s, 0] * x[2 * s] + slopes[s, 1] * x[2 * s + 1]
        density /= span**2 * chain.noise[t, m, 0]
        second /= span**2 * chain.noise[t, m, 1]
        for s in range(first, first + span):
            out[2 * s] -= density + slopes[s, 0] * second
            out[2 * s + 1] -= slopes[s, 1] * second


@kernel_part
def add_slope(
    road: RoadArrays, chain: Chain, n_stages: int, z: FloatArray, out: FloatArray
) -> None:
    """Add C'/R (C z + c - y), half the gradient of the measurements' part of the objective."""
    for t in range(n_stages):
        slopes = chain.slopes[t]
        for m in range(road.row_first.size):
            if not chain.observed[t, m]:
                continue
            first, span = road.row_first[m], road.row_span[m]
            density, second, part = 0.0, 0.0, 1.0 / span
            for s in range(first, first + span):
                rho, psi = z[t, 2 * s], z[t, 2 * s + 1]
                density += rho
                second += slopes[s, 0] * rho + slopes[s, 1] * psi + chain.constants[t, s]
            density = part * (part * density - chain.values[t, m, 0]) / chain.noise[t, m, 0]
            second = part * (part * second - chain.values[t, m, 1]) / chain.noise[t, m, 1]
            for s in range(first, first + span):
                out[t, 2 * s] += density + slopes[s, 0] * second
                out[t, 2 * s + 1] += slopes[s, 1] * second
