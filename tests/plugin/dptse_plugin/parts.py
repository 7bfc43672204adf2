"""The parts themselves."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from gymnasium import spaces

from dptse_env.estimators import Estimate, Estimator, Measurement
from dptse_env.release import PrivacyReport, PrivacySettings, ReleaseModel
from dptse_env.schedules import Schedule
from dptse_env.spaces.actions import ActionEncoding, Decision
from dptse_env.traffic import SHORT_HIGHWAY
from dptse_env.utils.validation import Interval, checked_fields

ROAD = SHORT_HIGHWAY.replaced(name="plugin-road", fixed_sensors=(0, 5))


@dataclass(frozen=True)
class SmoothedSettings:
    """Settings of `Smoothed`."""

    weight: Annotated[float, Interval(0, 1)] = 0.3

    def __post_init__(self) -> None:
        checked_fields(self, "estimator_settings")


class Smoothed(Estimator):
    """Exponential smoothing of releases of mean speeds; it does not read centred flows."""

    settings_type = SmoothedSettings

    def __init__(self, model: Any, n_episodes: int, settings: SmoothedSettings) -> None:
        super().__init__(model, n_episodes, settings)
        self.traffic = np.zeros((n_episodes, model.n_segments, 2))

    @property
    def _memory(self) -> Any:
        return (self.traffic,)

    def _reset(self, episodes: Any, states: Any, generators: Any) -> None:
        traffic = [self.model.density(states), self.model.speed(states)]
        self.traffic[episodes] = np.stack(traffic, axis=-1)

    def _predict(self, episodes: Any, inputs: Any) -> None:
        pass

    def _update(self, episodes: Any, measured: Measurement) -> None:
        weight, before = self.settings.weight, self.traffic[episodes]
        after = (1.0 - weight) * before + weight * measured.values
        self.traffic[episodes] = np.where(measured.observed[:, :, None], after, before)

    def _estimate(self) -> Estimate:
        density, speed = self.traffic[..., 0].copy(), self.traffic[..., 1].copy()
        return Estimate(density, speed, np.full_like(density, 20.0), np.full_like(speed, 10.0))


@dataclass(frozen=True)
class LaplaceSettings(PrivacySettings):
    """Settings of `LaplaceRelease`."""

    scale: Annotated[float, Interval(0, 100)] = 20.0


class LaplaceRelease(ReleaseModel):
    """Laplace noise, with a claim of its own."""

    settings_type = LaplaceSettings

    def __init__(self, task: Any, traffic: Any) -> None:
        super().__init__(task, traffic)
        self.streams: dict[int, np.random.Generator] = {}

    @property
    def sigma(self) -> Any:
        return 2**0.5 * self.task.settings.scale * np.array([1.0, 0.3])

    def reset(self, episodes: Any, generators: Any) -> None:
        self.streams.update(zip(episodes.tolist(), generators, strict=True))

    def release(self, request: Any) -> Measurement:
        values = self.traffic.aggregates(request.traffic, request.times, self.task.n_channels)
        for k, episode in enumerate(request.episodes.tolist()):
            values[k] += self.streams[episode].laplace(0.0, self.sigma / 2**0.5, values[k].shape)
        return self.measurement(request, values, self.sigma)

    def report(self) -> PrivacyReport:
        """Claim something, for the test that claims are shown as they are made."""
        return dataclasses.replace(super().report(), guarantee="a claim", void_reasons=())


def cheap_queries(second: Any) -> Any:
    """Minus the density error, and a price for each query."""
    error = second.error.density / second.corridor.scales.density_scale
    return -error - 0.01 * second.queried.sum(axis=1)


class MeanDensity:
    """The mean of the estimated densities over the road."""

    name, low, high = "mean_density", 0.0, 4.0

    def size(self, task: Any) -> int:
        return 1

    def values(self, state: Any, task: Any) -> Any:
        return (
            state.estimate.density.mean(axis=1, keepdims=True) / task.corridor.scales.density_scale
        )


class Neighbours(ActionEncoding):
    """``Discrete(n - 1)``: a segment and the next one downstream."""

    def make_space(self) -> Any:
        return spaces.Discrete(self.n_queries - 1)

    def decode(self, episodes: Any, actions: Any, pending: Any) -> Decision:
        ahead = np.arange(self.n_queries) - np.asarray(actions)[:, None]
        k = len(ahead)
        queried = (ahead == 0) | (ahead == 1)
        return Decision(queried, np.zeros(k, dtype=np.int64), np.ones(k, dtype=bool))

    def encode(self, queried: Any, picked: Any) -> Any:
        return queried.argmax(axis=1)


class MostJammed(Schedule):
    """The segments of highest estimated density."""

    def select(self, step: Any, observation: Any) -> Any:
        return self.highest(self.block(observation, "density")[:, : self.n_mainline], step)
