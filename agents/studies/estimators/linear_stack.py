"""The linear stack: a regression on what an EKF and a random walk say, now and before.

A baseline between the filters and a learned one: any filter that learns from traffic should do
better than 29 coefficients for densities and as many for speeds.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from agents.environments import make_config
from agents.evaluation.episodes import WARM_UP, run_episodes
from agents.experiments.runner import make_batch
from agents.files import write_json
from agents.seeds import TUNING
from agents.studies.estimators.worlds import World
from dptse_env.estimators import Estimate, EstimatorSettings
from dptse_env.estimators.batch import Measurements
from dptse_env.estimators.compiled.blend import CompiledBlend
from dptse_env.model import ARZModel
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Records
from dptse_env.utils.arrays import FloatArray, IntArray

STACK = "agents.studies.estimators.linear_stack:LinearStack"
LAGS = ((0, 0), (0, -1), (0, 1), (5, 0), (5, -1), (5, 1), (20, 0))
"""Ages [s] and offsets of segments of the estimates that enter."""
N_FEATURES = 4 * len(LAGS) + 1
_LONGEST = 21
RIDGE = 1e-5
"""Weight of the squared coefficients beside the mean squared error."""
EVERY = 5
"""Seconds between those that a fit uses."""


@dataclass(frozen=True)
class StackSettings(EstimatorSettings):
    """Settings of the filters, and the fit.

    Attributes:
        fit: File of the fit, as `write_fits` makes it; empty for the mean of both filters.
        world: Name of the world in the file.
    """

    fit: str = ""
    world: str = ""


@dataclass(frozen=True)
class StackFit:
    """Coefficients of densities and of speeds in units of the road, and factors on deviations."""

    coefficients: tuple[tuple[float, ...], tuple[float, ...]]
    factors: tuple[float, float]


EQUAL = StackFit(
    tuple(tuple(0.5 * float(k in (j, j + 2)) for k in range(N_FEATURES)) for j in (0, 1)),  # type: ignore[arg-type]
    (1.0, 1.0),
)
"""The mean of both filters."""


@cache
def read_fit(path: str, world: str) -> StackFit:
    """Read the fit of a world; an empty path gives `EQUAL`."""
    if not path:
        return EQUAL
    found = json.loads(Path(path).read_text(encoding="utf-8"))[world]
    density, speed = (tuple(map(float, each)) for each in found["coefficients"])
    return StackFit((density, speed), tuple(map(float, found["factors"])))  # type: ignore[arg-type]


class LinearStack(CompiledBlend):
    """An EKF and a random walk, and a linear function of their estimates."""

    settings_type: ClassVar[type[StackSettings]] = StackSettings

    def __init__(self, model: ARZModel, n_episodes: int, settings: StackSettings) -> None:
        """Read the fit."""
        super().__init__(model, n_episodes, settings)
        fit = read_fit(settings.fit, settings.world)
        self._coefficients, self._factors = np.array(fit.coefficients), fit.factors
        self._past = np.zeros((_LONGEST, n_episodes, model.n_segments, 4))
        self._count = np.zeros(n_episodes, dtype=np.int64)
        self._units = np.array([model.density_scale, model.speed_scale] * 2)

    def _restart(self, episodes: IntArray) -> None:
        super()._restart(episodes)
        self._past[:, episodes] = self._parts()[episodes]
        self._count[episodes] = 0

    def _update(self, measured: Measurements) -> None:
        super()._update(measured)
        episodes = measured.episodes
        self._past[self._count[episodes] % _LONGEST, episodes] = self._parts()[episodes]
        self._count[episodes] += 1

    def _parts(self) -> FloatArray:
        """Return densities and speeds of both filters in units of the road, shape (n, S, 4)."""
        each = [(part.density, part.speed) for part in (self.ekf.estimate(), self.walk.estimate())]
        parts: FloatArray = np.stack([array for pair in each for array in pair], -1) / self._units
        return parts

    def features(self) -> FloatArray:
        """Return what enters the regression, shape (n, S, 29): four numbers a lag, and 1."""
        n, S = self._past.shape[1:3]
        now, mainline = self._parts(), self.model.network.n_mainline
        found = []
        for age, offset in LAGS:
            table = (
                now if age == 0 else self._past[(self._count - 1 - age) % _LONGEST, np.arange(n)]
            )
            # The ends of the mainline, and ramps, are their own neighbours.
            place = np.arange(S)
            place[:mainline] = np.clip(place[:mainline] + offset, 0, mainline - 1)
            found.append(table[:, place])
        return np.concatenate([*found, np.ones((n, S, 1))], axis=-1)

    def _estimate(self) -> Estimate:
        features, blend = self.features(), super()._estimate()
        density, speed = (features @ each for each in self._coefficients)
        limit = 1.1 * max(self.model.network.speed_limits)
        return Estimate(
            np.clip(density * self._units[0], 0.0, self._units[0]),
            np.clip(speed * self._units[1], 0.0, limit),
            self._factors[0] * blend.density_std,
            self._factors[1] * blend.speed_std,
        )


def stack_settings(world: World, fit: str = "", name: str = "") -> StackSettings:
    """Return the settings of a stack in a world: those of its EKF, and the fit."""
    base = make_config(world.env, {**world.keywords, "estimator": "ekf"}).settings()
    fields = {field.name: getattr(base, field.name) for field in dataclasses.fields(base)}
    return StackSettings(**fields, fit=fit, world=name)


def fit_stack(
    world: World, seeds: Sequence[int], schedules: Sequence[str], records: Records
) -> dict[str, Any]:
    """Fit a stack by ridge regression on traffic seeds, and return it as plain JSON."""
    keywords = {**world.keywords, "estimator": STACK, "estimator_settings": stack_settings(world)}
    rows: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for schedule in schedules:
        env = make_batch(world.env, keywords, seeds, records)
        process, n = env.process, env.process.interface.n_mainline

        def on_second(process: Any = process, n: int = n) -> None:
            if process.time[0] <= WARM_UP or process.time[0] % EVERY:
                return
            stack, estimate = process.estimator, process.estimate
            spread = np.stack([estimate.density_std, estimate.speed_std], -1)[:, :n]
            truth = process.truth(np.arange(process.n_episodes))[:, :n] / stack._units[:2]
            table = stack.features()[:, :n]
            rows.append(
                tuple(x.reshape(-1, x.shape[-1]) for x in (table, truth, spread))  # type: ignore[arg-type]
            )

        noise = [TUNING.start + seed for seed in seeds]
        policy = make_schedule(schedule, env, 0)
        run_episodes(env, policy, traffic_seeds=seeds, seeds=noise, on_second=on_second)
        units = process.estimator._units[:2]  # type: ignore[attr-defined]
    table, truth, spread = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    coefficients, factors = [], []
    for j in range(2):
        counts = truth[:, 0] > 0.0 if j else np.ones(len(truth), dtype=bool)
        X, y = table[counts], truth[counts, j]
        own = np.linalg.solve(X.T @ X + RIDGE * len(X) * np.eye(N_FEATURES), X.T @ y)
        residual = (X @ own - y) * units[j] / spread[counts, j]
        coefficients.append(own.tolist())
        factors.append(float(np.sqrt(np.mean(residual**2))))
    return {"coefficients": coefficients, "factors": factors}


def write_fits(path: Path, fits: dict[str, Any]) -> None:
    """Write fits by world."""
    write_json(path, fits)
