"""Compiled sigma points of n episodes, made from mean and covariance and summarised as these.

With d_i the points' distances from the first one, d = W sum d_i and W the weight of all points
but the first, the weighted covariance is `W sum d_i d_i' + (beta - alpha^2) d d'`: the large
negative weights of the first point cancel without rounding errors, and the joint covariance of
states and measurements is positive semidefinite by construction, also of projected points.
"""

from typing import NamedTuple

from dptse_env.estimators.compiled.algebra import mirror
from dptse_env.estimators.compiled.dense import products
from dptse_env.utils.arrays import BoolArray, FloatArray
from dptse_env.utils.kernels import kernel_part


class Points(NamedTuple):
    """Sigma points of n episodes."""

    # (n, n_x, width) projected points after the last prediction [veh/km, veh/h, demand factors]:
    # that of the mean, then pairs; columns beyond 2 n_x + 1 repeat the first
    states: FloatArray
    centres: FloatArray  # (n, n_x) their weighted means, before any projection
    noise: FloatArray  # (n, n_x) variances of P beyond the points': the last step's process noise
    moved: BoolArray  # (n,) whether they were predicted since their last update
    scale: FloatArray  # (n_x,) units of the normalised components
    weight: float  # W of every point but the first
    surplus: float  # beta - alpha^2
    spread: float  # points are the mean plus and minus spread times columns of a root of P


@kernel_part
def draw(points: Points, e: int, mean: FloatArray, root: FloatArray) -> None:
    """Write one episode's points of a mean and the upper root of its covariance."""
    states, n = points.states[e], mean.size
    for i in range(n):
        row, centre = states[i], mean[i]
        row[:] = centre
        step = points.spread * points.scale[i]
        for k in range(i + 1):
            shift = step * root[k, i]
            row[1 + k] += shift
            row[1 + n + k] -= shift


@kernel_part(fastmath={"contract", "reassoc"})
def distances_from_first(row: FloatArray, scale: float, weight: float, out: FloatArray) -> float:
    """Write normalised distances from the first point and return their weighted sum."""
    first, inverse, total = row[0], 1.0 / scale, 0.0
    for j in range(row.size):
        out[j] = (row[j] - first) * inverse
        total += out[j]
    return weight * total


@kernel_part(kept=True, fastmath={"contract"})
def gather(
    points: Points,
    e: int,
    distances: FloatArray,
    shift: FloatArray,
    covariance: FloatArray,
) -> None:
    """Write mean and covariance of one episode's points."""
    states, n = points.states[e], shift.size
    for i in range(n):
        shift[i] = distances_from_first(states[i], points.scale[i], points.weight, distances[i])
        points.centres[e, i] = states[i, 0] + shift[i] * points.scale[i]
    products(distances, n, distances, n, True, covariance)
    for i in range(n):
        for j in range(i + 1):
            covariance[i, j] = (
                points.weight * covariance[i, j] + points.surplus * shift[i] * shift[j]
            )
    mirror(covariance)
