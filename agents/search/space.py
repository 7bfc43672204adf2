"""Search space of the settings of each estimator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import optuna

from dptse_env.estimators import EstimatorSettings


@dataclass(frozen=True)
class Range:
    """A setting between two values.

    Attributes:
        low: Least value.
        high: Greatest value.
        log: Whether its logarithm is searched evenly.
    """

    low: float
    high: float
    log: bool = True

    def suggest(self, trial: optuna.Trial, name: str) -> float:
        """Return a trial's value of the setting, rounded to four digits."""
        return float(f"{trial.suggest_float(name, self.low, self.high, log=self.log):.4g}")

    def holds(self, value: Any) -> bool:
        """Return true if the search can reach ``value``."""
        return bool(self.low <= value <= self.high)

    def at_bound(self, value: Any) -> bool:
        """Return true if ``value`` lies within a fiftieth of the range of an end."""
        scale = math.log if self.log else float
        share = (scale(value) - scale(self.low)) / (scale(self.high) - scale(self.low))
        return not 0.02 < share < 0.98


@dataclass(frozen=True)
class Choice:
    """A setting among a few values.

    Attributes:
        options: The values.
    """

    options: tuple[Any, ...]

    def suggest(self, trial: optuna.Trial, name: str) -> Any:
        """Return a trial's value of the setting."""
        return trial.suggest_categorical(name, self.options)

    def holds(self, value: Any) -> bool:
        """Return true if the search can reach ``value``."""
        return value in self.options

    def at_bound(self, value: Any) -> bool:
        """Return false: options have no ends."""
        return False


Knob = Range | Choice

_PROCESS_NOISE: Mapping[str, Knob] = {
    "process_noise.0": Range(1e-3, 5e-2),
    "process_noise.1": Range(1e-3, 5e-2),
}

# Q and R times one factor leave the estimates of all but the UKF as they are, and there alpha does
# what the factor would: R is known from the mechanism, so it stays and Q is searched.
NOISE_SCALE = {"noise_scale": Range(0.5, 3.0)}

SPACE: dict[str, Mapping[str, Knob]] = {
    "ekf": _PROCESS_NOISE,
    "ukf": {**_PROCESS_NOISE, "ukf.alpha": Range(0.1, 1.0)},
    "enkf": {
        **_PROCESS_NOISE,
        "enkf.inflation": Range(1.0, 1.1, log=False),
        "enkf.taper": Choice((None, 0.5, 1.0, 2.0)),
    },
    "mhe": {
        **_PROCESS_NOISE,
        "mhe.arrival_noise.0": Range(3e-3, 0.2),
        "mhe.arrival_noise.1": Range(3e-3, 0.2),
        "mhe.linearisation": Choice(("paper", "trajectory")),
        "mhe.bounds": Choice(("box", "cone")),
    },
    "random_walk": {"walk_noise.0": Range(1e-3, 0.1), "walk_noise.1": Range(1e-3, 0.1)},
}
"""By estimator: paths into `EstimatorSettings` and where their values are searched."""


def search_space(estimator: str, with_noise_scale: bool = False) -> dict[str, Knob]:
    """Return the search space of an estimator.

    Args:
        estimator: Its name.
        with_noise_scale: Whether to search the scale of R, too.

    Raises:
        ValueError: There is nothing to tune, or no such estimator.
    """
    if estimator == "open_loop":
        raise ValueError(
            f"estimator 'open_loop' has nothing to tune: it takes no measurements and follows the "
            f"model alone; tunable are {', '.join(SPACE)}"
        )
    if estimator not in SPACE:
        raise ValueError(f"estimator must be one of {', '.join(SPACE)}, got {estimator!r}")
    return {**SPACE[estimator], **(NOISE_SCALE if with_noise_scale else {})}


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by path as a mapping for `EstimatorSettings`.

    Both items of a pair must be there: ``{"process_noise.0": 1, "process_noise.1": 2}`` becomes
    ``{"process_noise": [1, 2]}``.
    """
    settings: dict[str, Any] = {}
    for path, value in values.items():
        *parents, name = path.split(".")
        is_item = name.isdecimal()
        if is_item:
            *parents, name = parents
        group = reduce(lambda node, key: node.setdefault(key, {}), parents, settings)
        if is_item:
            group.setdefault(name, []).append(value)
        else:
            group[name] = value
    return settings


def values_of(settings: EstimatorSettings, space: Mapping[str, Knob]) -> dict[str, Any]:
    """Return the value of every setting in ``space`` by path."""

    def at(path: str) -> Any:
        node: Any = settings
        for key in path.split("."):
            node = node[int(key)] if key.isdecimal() else getattr(node, key)
        return node

    return {path: at(path) for path in space}
