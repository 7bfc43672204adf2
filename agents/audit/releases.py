"""Release models as the adversary needs them: public terms, and sums without noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.release import (
    GaussianMechanism,
    GaussianRelease,
    Paced,
    ReleaseModel,
    ReleaseRequest,
    TwoMechanisms,
    require_gaussian,
)
from dptse_env.release.noise import NoiseStreams
from dptse_env.traffic import Record
from dptse_env.utils.arrays import AnyArray, FloatArray, IntArray


class Terms(NamedTuple):
    """Public numbers of a second of k episodes that its sums and their noise depend on.

    Attributes:
        sigma: Standard deviations of the noise, shape (k, C, 2).
        prices: Prices of the columns, shape (k, C); (k, 0) where none are charged.
        centres: Centres of speeds [km/h], shape (k, places); (k, 0) where they are constant.
    """

    sigma: FloatArray
    prices: FloatArray
    centres: FloatArray

    def repeated(self, times: int) -> Terms:
        """Return the terms of so many copies of the episodes, one after the other."""
        return Terms(*(np.concatenate([array] * times) for array in self))


class AttackedRelease(Protocol):
    """A release model under attack: everything but the noise follows from public numbers.

    Attributes:
        follows_estimates: Whether its terms depend on the estimator. Where they do not, estimates
            reveal nothing beyond the releases.
    """

    follows_estimates: ClassVar[bool]

    @property
    def model(self) -> ReleaseModel:
        """The release model."""

    def scale_noise(self, factor: float) -> None:
        """Multiply the noise, and leave what is declared of it as it is."""

    def terms(self, sigma: FloatArray) -> Terms:
        """Return the terms of the last release, that of the batch's first k episodes.

        Args:
            sigma: Deviations that the release declares, shape (k, C, 2); those of the terms are
                the real noise's.
        """

    def sums(self, request: ReleaseRequest, terms: Terms) -> FloatArray:
        """Return what a release would be without noise, shape (k, C, 2).

        Seconds are asked for in order and once each, since vehicles are charged.
        """


class AttackedGaussian:
    """A release model whose noise is the same at every step."""

    follows_estimates: ClassVar[bool] = False

    def __init__(self, model: GaussianRelease) -> None:
        """Attack this model."""
        self.model = model

    def scale_noise(self, factor: float) -> None:
        """See `AttackedRelease.scale_noise`."""
        setup = self.model.setup
        self.model.mechanism = GaussianMechanism(
            factor * self.model.sigma, n_episodes=setup.n_episodes, n_segments=setup.n_columns
        )

    def terms(self, sigma: FloatArray) -> Terms:
        """See `AttackedRelease.terms`."""
        nothing = np.empty((len(sigma), 0))
        return Terms(sigma, nothing, nothing)

    def sums(self, request: ReleaseRequest, terms: Terms) -> FloatArray:
        """See `AttackedRelease.sums`."""
        return self.model.true_values(request)


class AttackedPaced:
    """The paced ledger: the adversary keeps the ledgers of both worlds at the public prices."""

    follows_estimates: ClassVar[bool] = True

    def __init__(self, model: Paced) -> None:
        """Attack this model."""
        self.model, self._factor = model, 1.0
        self._lengths = model.setup.lengths

    def scale_noise(self, factor: float) -> None:
        """See `AttackedRelease.scale_noise`."""
        setup = self.model.setup
        self._factor = factor
        self.model.noise = NoiseStreams(setup.n_episodes, setup.n_columns, scale=factor)

    def terms(self, sigma: FloatArray) -> Terms:
        """See `AttackedRelease.terms`."""
        rows = slice(len(sigma))
        model = self.model
        return Terms(self._factor * sigma, model.prices[rows].copy(), model.centres[rows].copy())

    def sums(self, request: ReleaseRequest, terms: Terms) -> FloatArray:
        """See `AttackedRelease.sums`."""
        true = self.model.collect(request, terms.prices, terms.centres)
        sums: FloatArray = np.stack([true.counts, true.deviations], axis=-1)
        sums /= self._lengths[:, None]
        return sums


class AttackedPair:
    """Queries and fixed sensors together: the adversary reads both mechanisms."""

    follows_estimates: ClassVar[bool] = True

    def __init__(self, model: TwoMechanisms) -> None:
        """Attack this model."""
        self.model = model
        self.parts = [attacked(part) for part in model.parts]
        self._columns = np.cumsum([part.setup.n_columns for part in model.parts])[:-1]

    def scale_noise(self, factor: float) -> None:
        """See `AttackedRelease.scale_noise`."""
        for part in self.parts:
            part.scale_noise(factor)

    def terms(self, sigma: FloatArray) -> Terms:
        """See `AttackedRelease.terms`; those of the parts side by side."""
        columns = np.split(sigma, self._columns, axis=1)
        terms = [part.terms(own) for part, own in zip(self.parts, columns, strict=True)]
        return Terms(*(np.concatenate(arrays, axis=1) for arrays in zip(*terms, strict=True)))

    def sums(self, request: ReleaseRequest, terms: Terms) -> FloatArray:
        """See `AttackedRelease.sums`."""
        observed = np.split(request.observed, self._columns, axis=1)
        sums, starts = [], np.zeros(len(terms), dtype=np.int64)
        for part, seen in zip(self.parts, observed, strict=True):
            sizes = self._term_sizes(part.model)
            own = [
                array[:, start : start + size]
                for array, start, size in zip(terms, starts, sizes, strict=True)
            ]
            starts += sizes
            sums.append(part.sums(request._replace(observed=seen), Terms(*own)))
        return np.concatenate(sums, axis=1)

    @staticmethod
    def _term_sizes(model: ReleaseModel) -> IntArray:
        """Return how many columns of deviations, prices and centres a part has."""
        n_columns = model.setup.n_columns
        if isinstance(model, Paced):
            return np.array([n_columns, n_columns, model.setup.n_places])
        return np.array([n_columns, 0, 0])


def attacked(model: ReleaseModel) -> AttackedRelease:
    """Return how a release model is attacked.

    Raises:
        ValueError: It has noise that the adversary does not know the distribution of.
    """
    if isinstance(model, TwoMechanisms):
        return AttackedPair(model)
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
        super().__init__(model.setup)
        self.model = model

    @property
    def sigma(self) -> FloatArray:
        """See `ReleaseModel.sigma`."""
        return self.model.sigma

    @property
    def shared(self) -> tuple[AnyArray, ...]:
        """See `ReleaseModel.shared`."""
        return self.model.shared

    def load(self, index: int, record: Record) -> None:
        """See `ReleaseModel.load`."""
        self.model.load(index, record)

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`."""
        self.model.reset(episodes, generators)

    def release(self, request: ReleaseRequest) -> Measurement:
        """See `ReleaseModel.release`."""
        self.last = self.model.release(request)
        return self.last
