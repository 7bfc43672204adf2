"""Search space of each estimator: paths into `EstimatorSettings`, and where values are searched."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from functools import reduce
from typing import Any, Literal

from optuna.distributions import CategoricalDistribution, FloatDistribution

from dptse_env.estimators import DemandSettings, EstimatorSettings
from dptse_env.utils.validation import require_name

Knob = FloatDistribution | CategoricalDistribution
"""The values that the search can give a setting."""


def evenly(low: float, high: float) -> FloatDistribution:
    """Return a range whose logarithm is searched evenly."""
    return FloatDistribution(low, high, log=True)


_PROCESS_NOISE: dict[str, Knob] = {
    "process_noise.0": evenly(1e-3, 5e-2),
    "process_noise.1": evenly(1e-3, 5e-2),
}
_WALK_NOISE: dict[str, Knob] = {
    "walk_noise.0": evenly(1e-3, 0.1),
    "walk_noise.1": evenly(1e-3, 0.1),
}

SPACE: dict[str, dict[str, Knob]] = {
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
        "mhe.linearisation": CategoricalDistribution(("published", "trajectory")),
        "mhe.bounds": CategoricalDistribution(("box", "cone")),
    },
    "random_walk": _WALK_NOISE,
    "blend": {
        **_PROCESS_NOISE,
        **_WALK_NOISE,
        "blend.density_weight": FloatDistribution(0.0, 1.0),
        "blend.speed_weight": FloatDistribution(0.0, 1.0),
    },
    "asm": {
        "asm.time": evenly(2.0, 60.0),
        "asm.length": evenly(0.02, 0.5),
        "asm.jam_wave": FloatDistribution(12.0, 25.0),
        "asm.threshold": FloatDistribution(30.0, 90.0),
        "asm.boundary_weight": evenly(0.05, 5.0),
    },
}
"""By estimator."""

# Noise of vehicles and flicker explain what constant noise stands for otherwise, so that its best
# values are smaller.
_VEHICLES: dict[str, Knob] = {
    "process_noise.0": evenly(1e-4, 5e-2),
    "process_noise.1": evenly(1e-5, 5e-2),
    "vehicle_noise.0": evenly(1e-2, 0.1),
    "vehicle_noise.1": evenly(4e-3, 0.1),
    "flicker": CategoricalDistribution((True,)),
}

Extra = Literal["noise-scale", "vehicles", "demand", "speed-cap"]

EXTRAS: dict[Extra, dict[str, Knob]] = {
    # Q and R times one factor leave the estimates of all but the UKF as they are, and there alpha
    # does what the factor would: R is known from the mechanism, so it stays and Q is searched. What
    # may be searched is the weight of flows or speeds beside densities.
    "noise-scale": {
        "noise_scale.0": CategoricalDistribution((1.0,)),
        "noise_scale.1": evenly(0.5, 5.0),
    },
    "vehicles": _VEHICLES,
    "demand": {
        **_VEHICLES,
        "demand.deviation": evenly(0.02, 0.6),
        "demand.memory": evenly(10.0, 1e3),
    },
    "speed-cap": {"speed_cap": CategoricalDistribution((None, 0.95, 1.0, 1.05))},
}
"""Settings of every estimator that are searched where that is asked for."""

DEMAND_START = EstimatorSettings(
    process_noise=(5e-4, 5e-4),
    vehicle_noise=(0.045, 0.021),
    flicker=True,
    demand=DemandSettings(),
)
"""The settings with demand states from which a search begins."""


def search_space(estimator: str, extras: Collection[Extra] = ()) -> dict[str, Knob]:
    """Return the search space of an estimator, by path into `EstimatorSettings`.

    Args:
        estimator: A name in `SPACE`.
        extras: Names in `EXTRAS`.

    Raises:
        ValueError: The estimator has nothing to tune, or no traffic model.
    """
    require_name("estimators", estimator, SPACE)
    of_model = [extra for extra in ("vehicles", "demand") if extra in extras]
    if of_model and estimator in ("random_walk", "asm"):
        raise ValueError(
            f"also must leave out {of_model[0]} for {estimator!r}, which has no traffic model"
        )
    asked = (knobs for name, knobs in EXTRAS.items() if name in extras)
    return reduce(dict.__or__, asked, SPACE[estimator])


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


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by path as a mapping for `EstimatorSettings`, numbers rounded to four digits.

    Items of a pair stand in their order: ``{"process_noise.0": 1.0, "process_noise.1": 2.0}``
    becomes ``{"process_noise": [1.0, 2.0]}``.
    """
    settings: dict[str, Any] = {}
    for path, given in values.items():
        value = float(f"{given:.4g}") if isinstance(given, float) else given
        *parents, name = path.removesuffix(".0").removesuffix(".1").split(".")
        group = reduce(lambda node, key: node.setdefault(key, {}), parents, settings)
        if path.endswith((".0", ".1")):
            group.setdefault(name, []).append(value)
        else:
            group[name] = value
    return settings


def values_of(settings: EstimatorSettings, space: Mapping[str, Knob]) -> dict[str, Any]:
    """Return the value of every setting in ``space`` by path."""

    def below(node: Any, key: str) -> Any:
        return node[int(key)] if key.isdecimal() else getattr(node, key)

    return {path: reduce(below, path.split("."), settings) for path in space}
