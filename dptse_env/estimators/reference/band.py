"""Covariances that reach a band along the road, as dense matrices: a reference for the compiled.

See docs/long_roads.md for what a band is and why a covariance remains one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solve_triangular

from dptse_env.estimators.localisation import WHITENING, Places, within
from dptse_env.utils.arrays import FloatArray


class Scalars(NamedTuple):
    """Scalar measurements of a state, in the order in which they are taken in."""

    slopes: FloatArray  # (m, n) derivatives by the state
    residuals: FloatArray  # (m,) at the mean ahead of all of them
    noise: FloatArray  # (m,) variances


class DenseBand:
    """A band of covariances between components at places along the road."""

    def __init__(self, places: Places, band: int) -> None:
        """Take places and a band, in segments."""
        segment, position = places
        self._near = within(np.abs(position[:, None] - position), band)
        self._own = segment[:, None] == segment
        self._groups = np.eye(segment.max() + 1)[segment]  # (n, S), the choice of a segment

    def confine(self, covariance: FloatArray, before: FloatArray | None = None) -> FloatArray:
        """Leave out of a covariance what lies beyond the band.

        What this makes weaker are the correlations between segments, by as much as it takes for
        the matrix to remain a covariance; see `dptse_env.estimators.compiled.band_algebra`.

        Args:
            covariance: `(n, n)`.
            before: A covariance that is larger, whose blocks are used; None for the same.
        """
        own = np.where(self._own, covariance if before is None else before, 0.0)
        own += np.diag(WHITENING * np.diag(own))
        empty = np.diag(np.where(np.diag(own) > 0.0, 0.0, 1.0))
        root = np.linalg.cholesky(own + empty)
        correlations = solve_triangular(root, np.where(self._near, 0.0, covariance), lower=True)
        correlations = solve_triangular(root, correlations.T, lower=True)
        norms = np.sqrt(self._groups.T @ np.square(correlations) @ self._groups)
        lost = self._groups @ norms.sum(axis=1)
        kept = np.where(self._near, covariance, 0.0) + own * lost
        scale = 1.0 / np.sqrt(1.0 + lost)
        return np.asarray(kept * np.outer(scale, scale))

    def take_in(
        self, covariance: FloatArray, measured: Scalars
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the change of the mean, the covariance and the normalised innovations.

        Raises:
            LinAlgError: A predicted variance is not positive, or less than the noise.
        """
        shift = np.zeros(len(covariance))
        before = np.einsum("mi,ij,mj->m", measured.slopes, covariance, measured.slopes)
        innovations = measured.residuals / np.sqrt(before + measured.noise)
        for slope, residual, noise in zip(*measured, strict=True):
            along = covariance @ slope
            total = slope @ along + noise
            if not (0.0 < total < np.inf and total >= noise * (1.0 - 1e-9)):
                raise LinAlgError("a predicted variance is none")
            shift += along / total * (residual - slope @ shift)
            after = covariance - np.outer(along, along) / total
            covariance = self.confine(after, covariance)
        return shift, covariance, innovations
