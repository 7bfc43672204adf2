"""Compiled sigma points of a covariance that reaches a band along the road.

A column of such a covariance's root has entries at H + 1 places only, and a step carries them D
places further, on either side. So K = H + 2 D + 1 columns hold all points of one sign, as groups of
columns hold a sparse Jacobian (Curtis, Powell and Reid, 1974): point k is in column k modulo K, at
places where no other point of that column differs from the mean. Point k's distance from the mean
at place i is that of column k modulo K, if k lies from i - H - D to i + D, and otherwise zero.
"""

import numpy as np

from dptse_env.estimators.compiled.band import Band
from dptse_env.estimators.compiled.band_algebra import LARGEST_GROUP
from dptse_env.estimators.compiled.sigma_points import Points
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import inline_part, kernel_part


@inline_part
def n_columns(band: Band) -> int:
    """Return K."""
    return band.reach + 2 * band.step + 1


@kernel_part(fastmath={"contract", "reassoc"})
def factorise(band: Band, covariance: FloatArray, root: FloatArray) -> bool:
    """Write L with L L' = P, both in the form of a band; return whether all pivots are positive."""
    reach = band.reach
    for i in range(band.order.size):
        row = root[i]
        row[:] = 0.0
        for k in range(band.first[i], i + 1):
            start = max(band.first[i], band.first[k])
            mine = row[start - i + reach : k - i + reach]
            other = root[k, start - k + reach : reach]
            total = covariance[i, k - i + reach]
            for j in range(mine.size):
                total -= mine[j] * other[j]
            if k < i:
                row[k - i + reach] = total / root[k, reach]
            elif 0.0 < total < np.inf:
                row[reach] = np.sqrt(total)
            else:
                return False
    return True


@kernel_part
def draw(points: Points, band: Band, e: int, mean: FloatArray, root: FloatArray) -> None:
    """Write one episode's points of a mean and the root of its covariance."""
    count = n_columns(band)
    for i in range(band.order.size):
        row = points.states[e, band.order[i]]
        row[:] = mean[band.order[i]]
        step = points.spread * band.scale[i]
        for k in range(band.first[i], i + 1):
            shift = step * root[i, k - i + band.reach]
            row[1 + k % count] += shift
            row[1 + count + k % count] -= shift


@kernel_part
def distances_at(
    band: Band, place: int, row: FloatArray, unit: float, weight: float, out: FloatArray
) -> float:
    """Write the points' distances from the first one at a place, and return their weighted sum.

    Args:
        band: The band.
        place: The place.
        row: Numbers of the columns, that of the mean first.
        unit: What they are divided by.
        weight: Weight of a point.
        out: `(2 K,)` output, those of points k with both signs, k from i - H - D to i + D.
    """
    count, inverse, total = n_columns(band), 1.0 / unit, 0.0
    column = (place - band.reach - band.step + count) % count
    for t in range(count):
        plus, minus = row[1 + column] - row[0], row[1 + count + column] - row[0]
        out[2 * t], out[2 * t + 1] = plus * inverse, minus * inverse
        total += out[2 * t] + out[2 * t + 1]
        column = column + 1 if column + 1 < count else 0
    return weight * total


@kernel_part(fastmath={"contract", "reassoc"})
def moments(base: IntArray, distances: FloatArray, weight: float, wide: FloatArray) -> None:
    """Write weighted inner products of the points' distances at n places.

    Args:
        base: `(n,)` places along the road, ascending.
        distances: `(n, 2 K)`, from `distances_at`.
        weight: Weight of a point.
        wide: `(n, D + 1)` output; row i has the entries with i - D to i.
    """
    furthest, count = wide.shape[1] - 1, distances.shape[1] // 2
    for i in range(base.size):
        for j in range(max(0, i - furthest), i + 1):
            lag, total = base[i] - base[j], 0.0
            if lag < count:
                mine, other = distances[i, : 2 * (count - lag)], distances[j, 2 * lag :]
                for k in range(mine.size):
                    total += mine[k] * other[k]
            wide[i, j - i + furthest] = weight * total


@kernel_part
def add_surplus(shift: FloatArray, surplus: float, wide: FloatArray) -> None:
    """Add what the first point's weight contributes, `surplus` times shift shift', to `wide`."""
    furthest = wide.shape[1] - 1
    for i in range(shift.size):
        for j in range(max(0, i - furthest), i + 1):
            wide[i, j - i + furthest] += surplus * shift[i] * shift[j]


@kernel_part
def add_lost_surplus(
    start: IntArray,
    shift: FloatArray,
    surplus: float,
    roots: FloatArray,
    furthest: int,
    lost: FloatArray,
) -> None:
    """Add to each group's sum of lost correlations those of shift shift' beyond a table.

    Between groups a and b the norm is `surplus |B_a^-1/2 shift_a| |B_b^-1/2 shift_b|`.

    Args:
        start: `(G + 1,)` first number of each group, and n.
        shift: `(n,)`.
        surplus: Its weight.
        roots: Roots of the groups' own covariances.
        furthest: Largest distance of the table's entries, beyond which there is the surplus alone.
        lost: `(G,)`, added to.
    """
    n = lost.size
    norms, below, nearest = np.empty(n), np.zeros(n + 1), np.empty(n, dtype=np.int64)
    whitened = np.empty(LARGEST_GROUP)
    for a in range(n):
        square = 0.0
        for i in range(start[a + 1] - start[a]):
            total = shift[start[a] + i]
            for k in range(i):
                total -= roots[a, i, k] * whitened[k]
            whitened[i] = total / roots[a, i, i]
            square += whitened[i] ** 2
        norms[a] = np.sqrt(square)
        below[a + 1] = below[a] + norms[a]
        nearest[a] = nearest[a - 1] if a > 0 else 0
        while start[nearest[a]] < start[a + 1] - 1 - furthest:
            nearest[a] += 1
        lost[a] += surplus * norms[a] * below[nearest[a]]
    above, a = 0.0, n - 1
    for b in range(n - 1, -1, -1):
        while a >= 0 and nearest[a] > b:
            above += norms[a]
            a -= 1
        lost[b] += surplus * norms[b] * above
