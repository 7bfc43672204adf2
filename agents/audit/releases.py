"""Release models as the adversary needs them: public terms, and sums without noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.release import GaussianRelease, Paced, ReleaseModel, Request, require_gaussian
from dptse_env.release.noise import Noise
from dptse_env.utils.arrays import FloatArray, IntArray


class Terms(NamedTuple):
    """Public numbers of a second of k episodes that its sums and their noise depend on.

    Attributes:
        sigma: Standard deviations of the real noise, shape (k, C, 2).
        prices: Prices of the columns, shape (k, C); (k, 0) where none are charged.
        centre: Centres of speeds [km/h], shape (k, places).
    """

    sigma: FloatArray
    prices: FloatArray
    centre: FloatArray

    def repeated(self, times: int) -> Terms:
        """Return the terms of so many copies of the episodes, one after the other."""
        return Terms(*(np.concatenate([array] * times) for array in self))


class AttackedRelease(ABC):
    """A release model under attack: everything but the noise follows from public numbers.

    Attributes:
        follows_estimates: Whether its terms depend on the estimator. Where they do not, estimates
            reveal nothing beyond the releases.
        model: The release model.
    """

    follows_estimates: ClassVar[bool]
    model: GaussianRelease | Paced
    _factor = 1.0

    def scale_noise(self, factor: float) -> None:
        """Multiply the noise, and leave what is declared of it as it is."""
        task, self._factor = self.model.task, factor
        self.model.noise = Noise(task.n_episodes, task.n_columns, scale=factor)

    def terms(self, released: Measurement) -> Terms:
        """Return the terms of the last release, that of the batch's first k episodes."""
        k = len(released.sigma)
        return Terms(self._factor * released.sigma, self._prices(k), released.centre.copy())

    @abstractmethod
    def _prices(self, k: int) -> FloatArray: ...

    @abstractmethod
    def sums(self, request: Request, terms: Terms) -> FloatArray:
        """Return what a release would be without noise, shape (k, C, 2).

        Seconds are asked for in order and once each, since vehicles are charged.
        """


class AttackedGaussian(AttackedRelease):
    """A release model whose noise is the same at every step."""

    follows_estimates: ClassVar[bool] = False
    model: GaussianRelease

    def __init__(self, model: GaussianRelease) -> None:
        """Attack this model."""
        self.model = model

    def _prices(self, k: int) -> FloatArray:
        return np.empty((k, 0))

    def sums(self, request: Request, terms: Terms) -> FloatArray:
        """See `AttackedRelease.sums`."""
        return self.model.true_values(request)


class AttackedPaced(AttackedRelease):
    """The paced ledger: the adversary keeps the ledgers of both worlds at the public prices."""

    follows_estimates: ClassVar[bool] = True
    model: Paced

    def __init__(self, model: Paced) -> None:
        """Attack this model."""
        self.model = model

    def _prices(self, k: int) -> FloatArray:
        return self.model.prices[:k].copy()

    def sums(self, request: Request, terms: Terms) -> FloatArray:
        """See `AttackedRelease.sums`."""
        sums, _ = self.model.collect(request, terms.prices, terms.centre)
        sums /= self.model.task.length[:, None]
        return sums


def attacked(model: ReleaseModel) -> AttackedRelease:
    """Return how a release model is attacked.

    Raises:
        ValueError: It has noise that the adversary does not know the distribution of.
    """
    if isinstance(model, Paced):
        return AttackedPaced(model)
    return AttackedGaussian(require_gaussian(model, "the audit"))


class Overheard(ReleaseModel):
    """A release model that keeps what another one has released last: the public transcript.

    Attributes:
        model: The other one, which does everything.
        last: Its last release.
    """

    last: Measurement

    def __init__(self, model: ReleaseModel) -> None:
        """Listen to this model."""
        super().__init__(model.task, model.traffic)
        self.model = model

    @property
    def sigma(self) -> FloatArray:
        """See `ReleaseModel.sigma`."""
        return self.model.sigma

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`."""
        self.model.reset(episodes, generators)

    def release(self, request: Request) -> Measurement:
        """See `ReleaseModel.release`."""
        self.last = self.model.release(request)
        return self.last
