"""The protocol of estimators and their output.

An estimator follows a batch of episodes. A step is `predict` under the boundary inputs, then
`update` by the released values, then `estimate`. Both take the indices of the episodes that they
change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import numpy as np

from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

Backend = Literal["compiled", "reference"]


@dataclass(frozen=True)
class Estimate:
    """Estimates and their standard deviations, `(n, S)` each, in fresh arrays.

    Attributes:
        density: [veh/km].
        speed: [km/h].
        density_std: [veh/km].
        speed_std: [km/h].
    """

    density: FloatArray
    speed: FloatArray
    density_std: FloatArray
    speed_std: FloatArray

    def at(self, episodes: IntArray) -> Estimate:
        """Return a copy of the rows of `episodes` `(k,)`, `(k, S)` each."""
        return Estimate(
            self.density[episodes],
            self.speed[episodes],
            self.density_std[episodes],
            self.speed_std[episodes],
        )


class Estimator(Protocol):
    """Estimates the traffic state of a batch of episodes, S segments each.

    Attributes:
        is_compiled: Whether `predict` and `update` release Python's global interpreter lock, so
            that blocks of episodes benefit from threads.
        n_episodes: Episodes n in the batch.
        innovations: `(n, M, 2)` residuals of both releases before the last update, over their
            predicted standard deviations; 0 where nothing was observed.
        diverged: `(n,)` whether the last update found the filter non-finite or indefinite and
            reset it to its prior.
        fallback: `(n,)` whether the last update had no solution and left the estimate at the
            prediction.
    """

    is_compiled: ClassVar[bool]
    n_episodes: int
    innovations: FloatArray
    diverged: BoolArray
    fallback: BoolArray

    def reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        """Reset episodes.

        Args:
            episodes: `(k,)` distinct indices.
            states: `(k, 2 S)` prior means of the traffic; demand factors begin at 1.
            generators: A random stream per episode, for estimators that draw.
        """

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Predict episodes `(k,)` one step ahead under the model's inputs `(k, n_u)`."""

    def update(
        self,
        episodes: IntArray,
        observed: BoolArray,
        values: FloatArray,
        sigma: FloatArray,
        centre: FloatArray | None = None,
    ) -> None:
        """Update episodes by measurements, whose M rows are those of ``model.rows``.

        Args:
            episodes: `(k,)` distinct indices.
            observed: `(k, M)` flags of the rows that are measured.
            values: `(k, M, 2)` average density [veh/km] of a row's segments and, depending on the
                model, their speed [km/h] or average centred flow [veh/h]; ignored where not
                observed.
            sigma: Standard deviations of their noise, in the same units, `(k, M, 2)` or of a shape
                that broadcasts to it.
            centre: Speeds v_0 [km/h] that the flows are centred on, `(k, S)` or of a shape that
                broadcasts to it; None for the model's reference speed.
        """

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
