"""Compiled linear algebra of covariances that reach a band along the road.

They are stored as `dptse_env.estimators.compiled.band` says. What a step or a measurement makes of
such a covariance reaches further than the band, and leaving that out could make it indefinite.
For groups a and b let E be their covariance, B_a and B_b their own, and e the Frobenius norm of
`B_a^-1/2 E B_b^-1/2`. Then `[[e B_a, E], [E', e B_b]]` is positive semidefinite: where E is left
out and e B_a and e B_b are added, a covariance remains one. Dividing the rows and columns of each
group by `sqrt(1 + d)`, with d the sum of its e, gives it back its own covariance. So what is left
out makes correlations between groups weaker, and changes nothing within them.
"""

import numpy as np

from dptse_env.estimators.compiled.band import Band
from dptse_env.estimators.localisation import WHITENING
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part

LARGEST_GROUP = 4  # rho, psi and a demand factor, and what sensors release of the segment


@kernel_part(fastmath={"contract"})
def _multiply(
    road: RoadArrays,
    band: Band,
    blocks: FloatArray,
    by_factor: FloatArray,
    right: FloatArray,
    reach: int,
    centre: int,
    out: FloatArray,
    out_centre: int,
) -> None:
    """Write F right to `out`, as far as `out` has columns.

    Args:
        road: The road.
        band: Its places.
        blocks: `(S, K, 4)` blocks of F.
        by_factor: `(1 + I, 2)` derivatives by the demand factors, if the states have them.
        right: A matrix whose row i has the entry of place j in column j - i + `centre`.
        reach: Largest distance of two places whose entry is not zero; there is at least one zero
            column on either side.
        centre: Column of the diagonal of `right`.
        out: Output of the same form.
        out_centre: Column of its diagonal.
    """
    end = out.shape[1]
    out[:] = 0.0
    for c in range(road.jam.size):
        i = band.segment[c]
        for slot in range(road.degree[c]):
            a, b = blocks[c, slot, 0], blocks[c, slot, 1]
            d, e = blocks[c, slot, 2], blocks[c, slot, 3]
            if slot > 0 and a == 0.0 and b == 0.0 and d == 0.0 and e == 0.0:
                continue  # a flow depends on either demand or supply
            r = band.segment[road.neighbours[c, slot]]
            # Places from r - reach to r + 1 + reach.
            first = right[r, centre - reach : centre + reach + 2]
            second = right[r + 1, centre - reach - 1 : centre + reach + 1]
            start = r - reach - i + out_centre
            upper, lower = out[i, start:end], out[i + 1, start - 1 : end]
            for j in range(min(first.size, upper.size)):
                upper[j] += a * first[j] + b * second[j]
            for j in range(min(first.size, lower.size)):
                lower[j] += d * first[j] + e * second[j]
    for k in range(band.factor.size):
        f = band.factor[k]
        i = band.segment[road.entries[k]]
        source = right[f, centre - reach : centre + reach + 1]
        start = f - reach - i + out_centre
        upper, lower = out[i, start:end], out[i + 1, start - 1 : end]
        kept = out[f, out_centre - reach : end]
        for j in range(min(source.size, upper.size)):
            upper[j] += by_factor[k, 0] * source[j]
        for j in range(min(source.size, lower.size)):
            lower[j] += by_factor[k, 1] * source[j]
        for j in range(min(source.size, kept.size)):
            kept[j] = source[j]


@kernel_part
def make_tables(band: Band) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Allocate the scratch space of `propagate`."""
    n, reach, step = band.order.size, band.reach, band.step
    wide = 2 * (reach + step) + 4
    return (
        np.zeros((n, 2 * reach + 4)),
        np.empty((n, wide)),
        np.zeros((n, wide)),
        np.empty((n, reach + 2 * step + 2 * LARGEST_GROUP + 1)),
    )


@kernel_part
def propagate(
    road: RoadArrays,
    band: Band,
    blocks: FloatArray,
    by_factor: FloatArray,
    covariance: FloatArray,
    tables: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> None:
    """Replace a covariance by F P F', confined to the band.

    Args:
        road: The road.
        band: Its band.
        blocks: `(S, K, 4)` blocks of F, as written by `dptse_env.model.step.advance`.
        by_factor: `(1 + I, 2)` derivatives of the entries' cells by the demand factors.
        covariance: `(n_x, H + 1)`, replaced.
        tables: From `make_tables`.
    """
    full, product, transposed, moved = tables
    n, reach, step = band.order.size, band.reach, band.step
    centre, wide = reach + 1, reach + step + 1
    for i in range(n):
        for q in range(max(0, reach - i), reach + 1):
            j = i - reach + q
            full[i, centre + j - i] = covariance[i, q]
            full[j, centre + i - j] = covariance[i, q]
    _multiply(road, band, blocks, by_factor, full, reach, centre, product, wide)
    for i in range(n):
        for j in range(max(0, i - reach - step), min(n, i + reach + step + 1)):
            transposed[j, wide + i - j] = product[i, wide + j - i]
    furthest = reach + 2 * step + 2 * LARGEST_GROUP  # to hold groups as a whole
    _multiply(road, band, blocks, by_factor, transposed, reach + step, wide, moved, furthest)
    confine(band.first, band.group, band.start, moved, covariance)


@kernel_part
def confine(
    first: IntArray, group: IntArray, start: IntArray, wide: FloatArray, covariance: FloatArray
) -> None:
    """Write a covariance that reaches further than the band as one in the band.

    Args:
        first: `(n,)` first place in the band of each place.
        group: `(n,)` group of each place.
        start: `(G + 1,)` first place of each group, and n.
        wide: `(n, D + 1)` with the entries of places from i - D to i in row i.
        covariance: `(n, H + 1)` output.
    """
    roots = block_roots(wide, start)
    cut(first, group, wide, lost_beyond(first, group, start, wide, roots), covariance)


@kernel_part
def block_roots(wide: FloatArray, start: IntArray) -> FloatArray:
    """Return the roots of all groups' own covariances."""
    roots = np.zeros((start.size - 1, LARGEST_GROUP, LARGEST_GROUP))
    for a in range(start.size - 1):
        block_root(wide, start[a], start[a + 1] - start[a], roots[a])
    return roots


@kernel_part
def lost_beyond(
    first: IntArray, group: IntArray, start: IntArray, wide: FloatArray, roots: FloatArray
) -> FloatArray:
    """Return each group's sum d `(G,)` of correlations beyond the band, as far as `wide` goes.

    Groups that it holds in part are not looked at.
    """
    furthest, lost = wide.shape[1] - 1, np.zeros(start.size - 1)
    block = np.empty((LARGEST_GROUP, LARGEST_GROUP))
    for a in range(lost.size):
        b = group[first[start[a]]] - 1
        while b >= 0 and start[b] >= start[a + 1] - 1 - furthest:
            beyond = _correlation(wide, start, a, b, roots, block)
            lost[a] += beyond
            lost[b] += beyond
            b -= 1
    return lost


@kernel_part
def cut(
    first: IntArray, group: IntArray, wide: FloatArray, lost: FloatArray, covariance: FloatArray
) -> None:
    """Write what lies in the band, with correlations that are as much weaker as was `lost`."""
    reach, furthest = covariance.shape[1] - 1, wide.shape[1] - 1
    for i in range(first.size):
        a = group[i]
        scale = 1.0 / np.sqrt(1.0 + lost[a])
        for q in range(max(0, reach - i), reach + 1):
            j = i - reach + q
            value = wide[i, q + furthest - reach]
            if j < first[i]:
                covariance[i, q] = 0.0
            elif group[j] < a:
                covariance[i, q] = value * scale / np.sqrt(1.0 + lost[group[j]])
            else:
                covariance[i, q] = value
        covariance[i, reach] *= 1.0 + lost[a] * WHITENING * scale * scale


@kernel_part
def block_root(covariance: FloatArray, place: int, size: int, root: FloatArray) -> None:
    """Write the lower root of a group's own covariance, its variances enlarged by `WHITENING`."""
    diagonal = covariance.shape[1] - 1
    for i in range(size):
        for j in range(i + 1):
            total = covariance[place + i, diagonal + j - i]
            if i == j:
                total = total * (1.0 + WHITENING) if total > 0.0 else 1.0
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total / root[j, j] if j < i else np.sqrt(total)


@kernel_part
def _correlation(
    wide: FloatArray, start: IntArray, a: int, b: int, roots: FloatArray, block: FloatArray
) -> float:
    """Return the norm of the correlations of two groups."""
    furthest, rows, columns = wide.shape[1] - 1, start[a + 1] - start[a], start[b + 1] - start[b]
    for i in range(rows):
        for j in range(columns):
            total = wide[start[a] + i, start[b] + j - start[a] - i + furthest]
            for k in range(i):
                total -= roots[a, i, k] * block[k, j]
            block[i, j] = total / roots[a, i, i]
    square = 0.0
    for i in range(rows):
        for j in range(columns):
            total = block[i, j]
            for k in range(j):
                total -= block[i, k] * roots[b, j, k]
            block[i, j] = total / roots[b, j, j]
            square += block[i, j] * block[i, j]
    return float(np.sqrt(square))
