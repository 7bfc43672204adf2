"""The numbers that the claims are about, each an interval over traffic seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations, pairwise

import numpy as np

from agents.evaluation.statistics import (
    Interval,
    geometric_mean_interval,
    mean_interval,
    paired_difference,
)
from agents.studies.paper.plan import ESTIMATORS, Setting
from agents.studies.paper.results import FloatArray, Measured, correlations, roughness, slopes

LABELS = {
    "ekf": "EKF",
    "ukf": "UKF",
    "enkf": "EnKF",
    "mhe": "MHE",
    "random_walk": "random walk",
    "open_loop": "open loop",
}
DENSITY, SPEED = "rmse_density", "rmse_speed"
UNITS = {DENSITY: "veh/km", SPEED: "km/h"}

Measure = Callable[[Measured, Setting], Mapping[str, Interval]]


def percent(values: FloatArray, reference: FloatArray) -> Interval:
    """Return how much larger values are than their references [%]."""
    return mean_interval(100.0 * (values / reference - 1.0))


def _mean(m: Measured, field: str, name: str, setting: Setting, metric: str) -> FloatArray:
    """Return the mean of a curve over its points, for each seed."""
    mean: FloatArray = m.curve(field, name, setting, metric).mean(axis=0)
    return mean


def falls(metric: str) -> Measure:
    """Measure the slope of the error over the number of CV segments."""

    def measure(m: Measured, setting: Setting) -> Mapping[str, Interval]:
        places = np.array(m.design.sweeps["bandwidth"].values)
        curves = {name: m.curve("bandwidth", name, setting, metric) for name in ESTIMATORS}
        return {LABELS[name]: mean_interval(slopes(places, own)) for name, own in curves.items()}

    return measure


def against_others(name: str, metric: str, *fields: str) -> Measure:
    """Measure how far an estimator's mean error over a sweep lies above each other one's."""

    def measure(m: Measured, setting: Setting) -> Mapping[str, Interval]:
        parts = {}
        for field in fields:
            own = _mean(m, field, name, setting, metric)
            for other in ESTIMATORS:
                if other != name:
                    label = f"{LABELS[name]} − {LABELS[other]}"
                    label += f", over {_AXES[field]}" if len(fields) > 1 else ""
                    reference = _mean(m, field, other, setting, metric)
                    parts[label] = paired_difference(own, reference)
        return parts

    return measure


_AXES = {"bandwidth": "CV segments", "epsilon": "ε", "delta": "δ"}


def percent_apart(*pairs: tuple[str, str, str]) -> Measure:
    """Measure differences of mean errors over CV segments, each (estimator, reference, metric)."""

    def measure(m: Measured, setting: Setting) -> Mapping[str, Interval]:
        return {
            f"{LABELS[a]} to {LABELS[b]}, {_NAMES[metric]}": percent(
                _mean(m, "bandwidth", a, setting, metric), _mean(m, "bandwidth", b, setting, metric)
            )
            for a, b, metric in pairs
        }

    return measure


_NAMES = {DENSITY: "density", SPEED: "speed"}


def mhe_behind_ekf(m: Measured, setting: Setting) -> Mapping[str, Interval]:
    """Measure the MHE's speed error above the EKF's."""
    mhe, ekf = (_mean(m, "bandwidth", name, setting, SPEED) for name in ("mhe", "ekf"))
    return {"MHE − EKF": paired_difference(mhe, ekf)}


def enkf_rougher(m: Measured, setting: Setting) -> Mapping[str, Interval]:
    """Measure how much rougher the EnKF's density curve is than each other one."""
    rough = {name: roughness(m.curve("bandwidth", name, setting, DENSITY)) for name in ESTIMATORS}
    return {
        f"EnKF − {LABELS[name]}": paired_difference(rough["enkf"], own)
        for name, own in rough.items()
        if name != "enkf"
    }


def _correlation(a: FloatArray, b: FloatArray) -> Interval:
    """Return the mean correlation of two curves (n_points, n), by Fisher's transformation."""
    # A perfect correlation would go to infinity.
    per_seed = np.clip(correlations(a, b), -1.0 + 1e-9, 1.0 - 1e-9)
    z = mean_interval(np.arctanh(per_seed))
    mean, low, high = (float(np.tanh(end)) for end in (z.mean, z.low, z.high))
    return Interval(mean, low, high, z.n)


def alike_over_epsilon(m: Measured, setting: Setting) -> Mapping[str, Interval]:
    """Measure how two estimators' density curves over epsilon correlate."""
    curves = {name: m.curve("epsilon", name, setting, DENSITY) for name in ESTIMATORS}
    return {
        f"{LABELS[a]}, {LABELS[b]}": _correlation(curves[a], curves[b])
        for a, b in combinations(ESTIMATORS, 2)
    }


def speed_like_density(m: Measured, setting: Setting) -> Mapping[str, Interval]:
    """Measure how an estimator's density and speed curves correlate."""
    return {
        f"{LABELS[name]}, over {_AXES[field]}": _correlation(
            m.curve(field, name, setting, DENSITY), m.curve(field, name, setting, SPEED)
        )
        for field in ("epsilon", "delta")
        for name in ESTIMATORS
    }


def epsilon_matters_more(m: Measured, setting: Setting) -> Mapping[str, Interval]:
    """Measure the fall of the density error from end to end, over epsilon minus over delta."""
    parts = {}
    for name in ESTIMATORS:
        epsilon, delta = (m.curve(field, name, setting, DENSITY) for field in ("epsilon", "delta"))
        fall = epsilon[0] - epsilon[-1], delta[0] - delta[-1]
        parts[LABELS[name]] = paired_difference(*fall)
    return parts


def growth(field: str, low: float | None, high: float | None) -> Measure:
    """Measure how much the density error at one value of a sweep exceeds that at a higher one [%].

    Args:
        field: The sweep.
        low: The value of more privacy; None for the lowest.
        high: The value of less privacy; None for the highest.
    """

    def measure(m: Measured, setting: Setting) -> Mapping[str, Interval]:
        values = m.design.sweeps[field].values
        ends = values[0] if low is None else low, values[-1] if high is None else high
        return {
            LABELS[name]: percent(*(m.at(field, end, name, setting, DENSITY) for end in ends))
            for name in ESTIMATORS
        }

    return measure


def time_order(m: Measured, setting: Setting) -> Mapping[str, Interval]:
    """Measure ratios of times a step of neighbours in the paper's order."""
    order = ("ukf", "enkf", "mhe", "ekf")
    return {
        f"{LABELS[a]} / {LABELS[b]}": geometric_mean_interval(
            m.seconds(a, setting) / m.seconds(b, setting)
        )
        for a, b in pairwise(order)
    }


def below(reference: str, metric: str) -> Measure:
    """Measure every estimator's error minus a baseline's at the base point."""

    def measure(m: Measured, setting: Setting) -> Mapping[str, Interval]:
        other = m.base(reference, setting, metric)
        return {
            f"{LABELS[name]} − {LABELS[reference]}": paired_difference(
                m.base(name, setting, metric), other
            )
            for name in ESTIMATORS
        }

    return measure
