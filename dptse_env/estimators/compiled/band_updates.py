"""Compiled scalar updates of a covariance that reaches a band along the road; `band_algebra`."""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.compiled.band_algebra import LARGEST_GROUP, block_root
from dptse_env.estimators.localisation import WHITENING
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part


class Update(NamedTuple):
    """Working space of a step's measurements, n places in G groups."""

    shift: FloatArray  # (n,) change of the mean by the measurements so far
    scale: FloatArray  # (G,) a: P is a_i a_j times what is stored
    along: FloatArray  # (n,) c = P h
    stored: FloatArray  # (n,) c / a
    norms: FloatArray  # (G,) of c relative to the group's covariance
    sums: FloatArray  # (G,)
    root: FloatArray  # of a group's covariance, and in its last column `root^-1 c / a`


@kernel_part
def begin(n: int, n_groups: int) -> Update:
    """Return the working space ahead of the first measurement."""
    places, groups = np.zeros((3, n)), np.ones((3, n_groups))
    root = np.zeros((LARGEST_GROUP, LARGEST_GROUP + 1))
    return Update(places[0], groups[0], places[1], places[2], groups[1], groups[2], root)


@kernel_part
def finish(covariance: FloatArray, group: IntArray, work: Update) -> None:
    """Scale the covariance after the last measurement."""
    reach = covariance.shape[1] - 1
    for i in range(covariance.shape[0]):
        scale = work.scale[group[i]]
        for q in range(max(0, reach - i), reach + 1):
            covariance[i, q] *= scale * work.scale[group[i - reach + q]]


@kernel_part(fastmath={"contract"})
def scalar_update(
    covariance: FloatArray,
    first: IntArray,
    last: IntArray,
    group: IntArray,
    start: IntArray,
    places: IntArray,
    slopes: FloatArray,
    residual: float,
    noise: float,
    work: Update,
) -> bool:
    """Update by a scalar measurement, P - c c' / s with c = P h and s = h' c + r.

    Groups on either side of the measurement, further from one another than the band, would become
    correlated, by `-c_a c_b' / s`: that is left out.

    Args:
        covariance: `(n, H + 1)`, replaced; P up to the scale in `work`.
        first: `(n,)` first place in the band of each place.
        last: `(n,)` last place in it.
        group: `(n,)` group of each place.
        start: `(G + 1,)` first place of each group, and n.
        places: Places that are measured, ascending.
        slopes: Derivatives of the measurement by them.
        residual: That of the mean ahead of this step's measurements.
        noise: Variance of the measurement's noise.
        work: From `begin`.

    Returns:
        Whether the predicted variance is finite, positive and no less than the noise.
    """
    reach, m = covariance.shape[1] - 1, places.size
    low, high = first[places[0]], last[places[m - 1]]
    along, stored = work.along, work.stored
    stored[low : high + 1] = 0.0
    for k in range(m):
        p, slope = places[k], slopes[k] * work.scale[group[places[k]]]
        for j in range(first[p], p + 1):
            stored[j] += slope * covariance[p, j - p + reach]
        for j in range(p + 1, last[p] + 1):
            stored[j] += slope * covariance[j, p - j + reach]
    for j in range(low, high + 1):
        along[j] = work.scale[group[j]] * stored[j]
    total, step = noise, residual
    for k in range(m):
        total += slopes[k] * along[places[k]]
        step -= slopes[k] * work.shift[places[k]]
    if not (0.0 < total < np.inf and total >= noise * (1.0 - 1e-9)):
        return False
    inverse = 1.0 / total
    _measure_groups(covariance, group[low], group[high], start, work)
    for i in range(low, high + 1):
        begun, gain = max(first[i], low), stored[i] * inverse
        work.shift[i] += along[i] * inverse * step
        row, others = covariance[i, begun - i + reach :], stored[begun : i + 1]
        for j in range(others.size):
            row[j] -= gain * others[j]
    running = work.sums[group[high]]
    for a in range(group[low], group[high] + 1):
        here, nearest = start[a], group[max(first[start[a]], low)]
        beyond = running - work.sums[min(group[last[here]], group[high])]
        if nearest > group[low]:
            beyond += work.sums[nearest - 1]
        if beyond > 0.0:
            _weaken(covariance, here, start[a + 1], inverse, work.norms[a] * inverse * beyond, work)
            work.scale[a] /= np.sqrt(1.0 + work.norms[a] * inverse * beyond)
    return True


@kernel_part
def _measure_groups(
    covariance: FloatArray, low: int, high: int, start: IntArray, work: Update
) -> None:
    """Write the norms of c in groups from `low` to `high`, and the sums of them so far."""
    running, root = 0.0, work.root
    for a in range(low, high + 1):
        size, square = start[a + 1] - start[a], 0.0
        block_root(covariance, start[a], size, root)
        for i in range(size):
            total = work.stored[start[a] + i]
            for k in range(i):
                total -= root[i, k] * root[k, LARGEST_GROUP]
            root[i, LARGEST_GROUP] = total / root[i, i]
            square += root[i, LARGEST_GROUP] ** 2
        work.norms[a] = np.sqrt(square)
        running += work.norms[a]
        work.sums[a] = running


@kernel_part
def _weaken(
    covariance: FloatArray, start: int, end: int, inverse: float, lost: float, work: Update
) -> None:
    """Add to a group's covariance a multiple of what it was ahead of the measurement."""
    reach, stored = covariance.shape[1] - 1, work.stored
    for i in range(start, end):
        for j in range(start, i + 1):
            before = covariance[i, j - i + reach] + stored[i] * stored[j] * inverse
            enlarged = 1.0 + WHITENING if i == j else 1.0
            covariance[i, j - i + reach] += lost * enlarged * before


@kernel_part
def variance_of(
    covariance: FloatArray, first: IntArray, places: IntArray, slopes: FloatArray
) -> float:
    """Return the variance of a linear function of places, which are ascending."""
    reach, total = covariance.shape[1] - 1, 0.0
    for k in range(places.size):
        p = places[k]
        total += slopes[k] * slopes[k] * covariance[p, reach]
        for m in range(k):
            if places[m] >= first[p]:
                total += 2.0 * slopes[k] * slopes[m] * covariance[p, places[m] - p + reach]
    return total


@kernel_part
def is_covariance(covariance: FloatArray) -> bool:
    """Return whether variances are finite and not negative and no correlation exceeds one."""
    n, reach = covariance.shape[0], covariance.shape[1] - 1
    for i in range(n):
        if not 0.0 <= covariance[i, reach] < np.inf:
            return False
    possible = 0
    for i in range(n):
        allowed = (1.0 + 1e-9) * covariance[i, reach]
        start = max(0, reach - i)
        for q in range(start, reach + 1):
            value = covariance[i, q]
            # A NaN is not counted.
            if value * value <= allowed * covariance[i - reach + q, reach] + 1e-24:
                possible += 1
        possible -= reach + 1 - start
    return bool(possible == 0)
