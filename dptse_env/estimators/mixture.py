"""A mixture of estimators, weighted by how well each predicts the releases."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from dptse_env.estimators.base import Estimate, Estimator, Measurement, Played
from dptse_env.estimators.recurrent import SHIPPED, Recurrent, weights_for
from dptse_env.estimators.settings import PATH, EstimatorSettings, RecurrentSettings
from dptse_env.model import ARZModel
from dptse_env.road import Road
from dptse_env.utils.arrays import AnyArray, FloatArray, IntArray
from dptse_env.utils.validation import require, within

LEAST_VARIANCE = 1e-12


class Mixture(Estimator):
    """Experts on the same measurements, weighted by their likelihoods.

    With a released number y, its prediction m_i by expert i and V_i the variance of that
    prediction, noise included, an expert's log-likelihood decays with a memory of T steps:

        L_i <- (1 - 1 / T) L_i - sum ((y - m_i)^2 / V_i + log V_i) / 2

    over all numbers that are released. Its weight is in proportion to exp(L_i); means and variances
    are those of the mixture. What is released is public, and so are the weights.

    Where an expert diverges, all are reset to the prior, and the weights are equal again.

    Attributes:
        experts: The estimators.
    """

    is_compiled: ClassVar[bool] = True
    has_demand: ClassVar[bool] = False
    steps_model: ClassVar[bool] = False  # an expert may: see `check_settings`

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._fading = 1.0 - model.time_step / settings.mixture.memory
        self.experts: list[Estimator] = [
            kind(model, n_episodes, own)
            for kind, own in _experts(settings, model.road, model.releases_flow)
        ]
        self._likelihoods = np.zeros((len(self.experts), n_episodes))
        self._priors = np.zeros((n_episodes, 2 * model.n_segments))
        self._streams: list[np.random.Generator | None] = [None] * n_episodes

    @staticmethod
    def check_settings(model: ARZModel, settings: EstimatorSettings) -> None:
        """Refuse settings that an expert cannot have on the road."""
        from dptse_env.estimators import check_settings  # noqa: PLC0415 (which names this module)

        for kind, own in _experts(settings, model.road, model.releases_flow):
            with within(f"{PATH}.mixture.experts: "):
                check_settings(kind, model, own)

    @classmethod
    def inherits(cls, road: Road, played: Played, settings: EstimatorSettings) -> dict[str, str]:
        """Return the setting of the experts where no weights were trained on such roads."""
        experts = _experts(settings, road, bool(played["flows"][0]))
        with within(f"{PATH}.mixture.experts: "):
            found = [
                kind.inherits(road, played, own).values()
                for kind, own in experts
                if issubclass(kind, Recurrent)
            ]
        known = "; ".join(each for reasons in found for each in reasons)
        return {"estimator_settings.mixture.experts": known} if found and all(found) else {}

    @property
    def weights(self) -> FloatArray:
        """Weights of the experts, which add to 1, shape (number of experts, n)."""
        weights: FloatArray = np.exp(self._likelihoods - self._likelihoods.max(axis=0))
        weights /= weights.sum(axis=0)
        return weights

    @property
    def means(self) -> FloatArray:
        """Densities [veh/km] and speeds [km/h], shape (n, S, 2)."""
        estimate = self._estimate()
        return np.stack([estimate.density, estimate.speed], axis=-1)

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        of_experts = (array for expert in self.experts for array in expert.memory)
        return *of_experts, self._likelihoods.T, self._priors

    @property
    def _limits(self) -> tuple[tuple[AnyArray, float, float], ...]:
        return tuple(limit for expert in self.experts for limit in expert._limits)

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._priors[episodes] = states
        for episode, stream in zip(episodes.tolist(), generators, strict=True):
            self._streams[episode] = stream
        self._restart(episodes)

    def _restart(self, episodes: IntArray) -> None:
        streams = [self._streams[episode] for episode in episodes.tolist()]
        for expert in self.experts:
            expert.reset(episodes, self._priors[episodes], streams)
        self._likelihoods[:, episodes] = 0.0

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        for expert in self.experts:
            expert._predict(episodes, inputs)

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        observed = measured.observed[..., None]
        errors, variances = self._errors(self._estimate().at(episodes), measured)
        self.innovations[episodes] = np.where(observed, errors / np.sqrt(variances), 0.0)
        for expert, likelihood in zip(self.experts, self._likelihoods, strict=True):
            errors, variances = self._errors(expert._estimate().at(episodes), measured)
            costs = np.where(observed, errors**2 / variances + np.log(variances), 0.0)
            likelihood[episodes] *= self._fading
            likelihood[episodes] -= 0.5 * costs.sum(axis=(1, 2))
            expert._update(episodes, measured)
        self.diverged[episodes] = np.any([each.diverged[episodes] for each in self.experts], axis=0)
        self.fallback[episodes] = np.any([each.fallback[episodes] for each in self.experts], axis=0)
        lost = episodes[self.diverged[episodes]]
        if lost.size > 0:
            self.innovations[lost] = 0.0
            self._restart(lost)

    def _errors(self, estimate: Estimate, measured: Measurement) -> tuple[FloatArray, FloatArray]:
        """Return errors (k, M, 2) of predicted releases, and their variances."""
        density, speed, density_std, speed_std = estimate
        second, variance = speed, speed_std**2
        if self.model.releases_flow:
            slip = speed - measured.centre
            second = density * slip
            variance = (density * speed_std) ** 2 + (slip * density_std) ** 2
        # einsum, whose bits do not depend on the batch as those of a product of matrices do.
        means = self.model.averages(np.stack([density, second], axis=-1))
        variances = np.einsum(
            "ms,nsk->nmk", self.model.averaging**2, np.stack([density_std**2, variance], axis=-1)
        )
        return measured.values - means, np.maximum(variances + measured.sigma**2, LEAST_VARIANCE)

    def _estimate(self) -> Estimate:
        weights = self.weights[..., None]
        table = np.array([expert._estimate() for expert in self.experts])
        means = (weights[:, None] * table[:, :2]).sum(axis=0)
        squares = table[:, 2:] ** 2 + (table[:, :2] - means) ** 2
        return Estimate(*means, *np.sqrt((weights[:, None] * squares).sum(axis=0)))


def _experts(
    settings: EstimatorSettings, road: Road, flows: bool
) -> list[tuple[type[Estimator], EstimatorSettings]]:
    """Return the classes and settings of the experts; other names are those of weights.

    Raises:
        ValueError: An estimator cannot be found, or is a mixture.
    """
    from dptse_env.estimators import ESTIMATORS  # noqa: PLC0415 (which names this module)

    found: list[tuple[type[Estimator], EstimatorSettings]] = []
    for name in settings.mixture.experts or _weights_on(road, flows):
        if name in ESTIMATORS or ":" in name:
            with within(f"{PATH}.mixture.experts: "):
                kind = ESTIMATORS.find(name)
            other = not issubclass(kind, Mixture)
            require(other, f"{PATH}.mixture.experts", "other estimators than a mixture", name)
            found.append((kind, settings))
        else:
            own = dataclasses.replace(settings, recurrent=RecurrentSettings(name))
            found.append((Recurrent, own))
    return found


def _weights_on(road: Road, flows: bool) -> tuple[str, str]:
    """Return the weights that `Recurrent` would take on a road, and those of most kinds of roads.

    Where these are the same, they come second, after the first of `SHIPPED`.
    """
    own, (first, *_, last) = weights_for(None, road, flows).source.rpartition("-")[0], SHIPPED
    return (own, last) if own != last else (first, last)
