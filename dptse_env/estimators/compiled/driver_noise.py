"""Compiled process noise in (rho, w), as that of (rho, psi) around a mean.

With `psi = rho w`, independent deviations of rho and w are to first order deviations of psi:
`d_psi = w d_rho + rho d_w`. A cell's noise then has the covariance
`[[a, w a], [w a, w^2 a + rho^2 b]]`, with a and b the variances of rho and w.
"""

from dptse_env.estimators.compiled.moments import mean_of
from dptse_env.estimators.normals import Draws
from dptse_env.model.network import RoadArrays
from dptse_env.model.parameters import LARGEST_W, LEAST_DENSITY, VACUUM
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part


@kernel_part
def drivers(rho: float, psi: float, jam: float, v_f: float) -> tuple[float, float]:
    """Return the density [veh/km] and the w [km/h] at a mean, as `dptse_env.estimators.noise`."""
    w = psi / rho if rho > VACUUM * jam else v_f
    return max(rho, LEAST_DENSITY), min(max(w, 0.0), LARGEST_W * v_f)


@kernel_part
def couple(
    road: RoadArrays, scale: float, mean: FloatArray, variance: FloatArray, coupling: FloatArray
) -> None:
    """Turn the variances of rho and w of a step's noise into those of rho and psi.

    Args:
        road: The road.
        scale: rho_m [veh/km].
        mean: `(n_x,)` that the step leads to [veh/km, veh/h].
        variance: `(n_x,)` of rho over rho_m and w over v_f; those of w are replaced by psi's.
        coupling: `(S,)` output, the covariance of each segment's rho and psi, normalised.
    """
    v_f = road.free_flow_speed
    for s in range(road.jam.size):
        rho, w = drivers(mean[2 * s], mean[2 * s + 1], road.jam[s], v_f)
        share, w = rho / scale, w / v_f
        coupling[s] = w * variance[2 * s]
        variance[2 * s + 1] = w * coupling[s] + share * share * variance[2 * s + 1]


@kernel_part
def add_coupling(covariance: FloatArray, coupling: FloatArray) -> None:
    """Add to a covariance what the noise of each segment's rho and psi have in common."""
    for s in range(coupling.size):
        covariance[2 * s, 2 * s + 1] += coupling[s]
        covariance[2 * s + 1, 2 * s] += coupling[s]


@kernel_part
def couple_members(
    road: RoadArrays,
    scale: float,
    members: FloatArray,
    n: int,
    deviation: FloatArray,
    draws: Draws,
) -> None:
    """Move the members' psi along with the noise of rho, and turn deviations of w into psi's.

    Args:
        road: The road.
        scale: rho_m [veh/km].
        members: `(n_x, width)` after a step, before its noise.
        n: Number of members; density and w are those of their mean.
        deviation: `(n_x,)` of rho [veh/km] and of w times rho_m [veh/h], replaced by psi's.
        draws: `(n_x n,)` standard normal numbers, n for each component.
    """
    for s in range(road.jam.size):
        row = members[2 * s + 1]
        means = mean_of(members[2 * s], n), mean_of(row, n)
        rho, w = drivers(means[0], means[1], road.jam[s], road.free_flow_speed)
        size, draw = w * deviation[2 * s], draws[2 * s * n : (2 * s + 1) * n]
        for j in range(n):
            row[j] += size * draw[j]
        deviation[2 * s + 1] *= rho / scale
