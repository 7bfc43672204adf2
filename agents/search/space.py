"""Search space of the settings of each estimator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import reduce
from typing import Any

from optuna.distributions import CategoricalDistribution, FloatDistribution

from dptse_env.estimators import DemandSettings, EstimatorSettings

Knob = FloatDistribution | CategoricalDistribution
"""The values that the search can give a setting."""


def evenly(low: float, high: float) -> FloatDistribution:
    """Return a range whose logarithm is searched evenly."""
    return FloatDistribution(low, high, log=True)


def holds(knob: Knob, value: Any) -> bool:
    """Return true if the search can reach ``value``."""
    if isinstance(knob, CategoricalDistribution):
        return value in knob.choices
    return bool(knob.low <= value <= knob.high)


def at_bound(knob: Knob, value: Any) -> bool:
    """Return true if ``value`` lies within a fiftieth of a range of one of its ends."""
    if isinstance(knob, CategoricalDistribution):
        return False
    scale = math.log if knob.log else float
    share = (scale(value) - scale(knob.low)) / (scale(knob.high) - scale(knob.low))
    return not 0.02 < share < 0.98


def rounded(value: Any) -> Any:
    """Return a suggested value, numbers rounded to four digits."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


_PROCESS_NOISE: Mapping[str, Knob] = {
    "process_noise.0": evenly(1e-3, 5e-2),
    "process_noise.1": evenly(1e-3, 5e-2),
}

_WALK_NOISE: Mapping[str, Knob] = {
    "walk_noise.0": evenly(1e-3, 0.1),
    "walk_noise.1": evenly(1e-3, 0.1),
}

# Demand states explain what constant process noise stands for otherwise, so that its best values
# are smaller.
DEMAND: Mapping[str, Knob] = {
    "process_noise.0": evenly(1e-4, 5e-2),
    "process_noise.1": evenly(1e-5, 5e-2),
    "density_growth": evenly(1e-4, 0.1),
    "count_noise": evenly(3e-3, 3.0),
    "demand.deviation": evenly(0.02, 0.6),
    "demand.walk": evenly(1e-3, 0.3),
}
"""Settings that are searched where demand states are."""

DEMAND_START = EstimatorSettings(
    process_noise=(0.0061, 0.001),
    density_growth=0.0115,
    count_noise=0.09,
    noise_scale=(1.0, 1.2),
    demand=DemandSettings(),
)
"""The settings with demand states from which a search begins."""

# Q and R times one factor leave the estimates of all but the UKF as they are, and there alpha does
# what the factor would: R is known from the mechanism, so it stays and Q is searched. What may be
# searched is the weight of flows or speeds beside densities.
NOISE_SCALE: Mapping[str, Knob] = {
    "noise_scale.0": CategoricalDistribution((1.0,)),
    "noise_scale.1": evenly(0.5, 5.0),
}

SPEED_CAP: Mapping[str, Knob] = {"speed_cap": CategoricalDistribution((None, 0.95, 1.0, 1.05))}

SPACE: dict[str, Mapping[str, Knob]] = {
    "ekf": _PROCESS_NOISE,
    "ukf": {**_PROCESS_NOISE, "ukf.alpha": evenly(0.1, 1.0)},
    "enkf": {
        **_PROCESS_NOISE,
        "enkf.inflation": FloatDistribution(1.0, 1.1),
        "enkf.taper": CategoricalDistribution((None, 0.5, 1.0, 2.0)),
    },
    "mhe": {
        **_PROCESS_NOISE,
        "mhe.arrival_noise.0": evenly(3e-3, 0.2),
        "mhe.arrival_noise.1": evenly(3e-3, 0.2),
        "mhe.linearisation": CategoricalDistribution(("paper", "trajectory")),
        "mhe.bounds": CategoricalDistribution(("box", "cone")),
    },
    "random_walk": _WALK_NOISE,
    "blend": {
        **_PROCESS_NOISE,
        **_WALK_NOISE,
        "blend.density_weight": FloatDistribution(0.0, 1.0),
        "blend.speed_weight": FloatDistribution(0.0, 1.0),
    },
}
"""By estimator: paths into `EstimatorSettings` and where their values are searched."""


NOT_TUNED = {
    "open_loop": "it takes no measurements and follows the model alone",
    "recurrent": "its weights are trained by scripts/train_estimator.py",
}
"""Estimators that have nothing to tune, with the reason."""


def search_space(
    estimator: str,
    with_noise_scale: bool = False,
    with_demand: bool = False,
    with_speed_cap: bool = False,
) -> dict[str, Knob]:
    """Return the search space of an estimator.

    Args:
        estimator: Its name.
        with_noise_scale: Whether to search the scale of the noise of flows or speeds.
        with_demand: Whether to search demand states and the noise that goes with them.
        with_speed_cap: Whether to search the cap of reported speeds.

    Raises:
        ValueError: There is nothing to tune, no such estimator, or it has no demand states.
    """
    if estimator in NOT_TUNED:
        raise ValueError(
            f"estimator {estimator!r} has nothing to tune: {NOT_TUNED[estimator]}; tunable are "
            f"{', '.join(SPACE)}"
        )
    if estimator not in SPACE:
        raise ValueError(f"estimator must be one of {', '.join(SPACE)}, got {estimator!r}")
    if with_demand and estimator == "random_walk":
        raise ValueError("demand must be left out for 'random_walk', which has no traffic model")
    return {
        **SPACE[estimator],
        **(NOISE_SCALE if with_noise_scale else {}),
        **(DEMAND if with_demand else {}),
        **(SPEED_CAP if with_speed_cap else {}),
    }


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
