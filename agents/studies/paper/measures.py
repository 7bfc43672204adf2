"""Quantities that the claims are about, each as an interval over traffic seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise

import numpy as np

from agents.experiments.cells import DENSITY, METRICS, SPEED
from agents.figures import LABELS
from agents.statistics import (
    Interval,
    geometric_mean_interval,
    mean_interval,
    paired_difference,
)
from agents.studies.paper.plan import PAPER_ESTIMATORS, Setting
from agents.studies.paper.results import PaperResults, correlations, roughness, slopes
from dptse_env.utils.arrays import FloatArray

Parts = Mapping[str, Interval]
"""Intervals by the name of the part of a claim."""


def percent(values: FloatArray, reference: FloatArray) -> Interval:
    """Return by how much values exceed their references [%]."""
    return mean_interval(100.0 * (values / reference - 1.0))


def _mean(m: PaperResults, field: str, name: str, setting: Setting, metric: str) -> FloatArray:
    """Return the mean of a curve over its points, for each seed."""
    mean: FloatArray = m.curve(field, name, setting, metric).mean(axis=0)
    return mean


def falls(m: PaperResults, setting: Setting, *, metric: str) -> Parts:
    """Measure the slope of the error over the number of CV segments."""
    places = np.array(m.design.sweeps["bandwidth"])
    curves = {name: m.curve("bandwidth", name, setting, metric) for name in PAPER_ESTIMATORS}
    return {LABELS[name]: mean_interval(slopes(places, y)) for name, y in curves.items()}


def against_rest(
    m: PaperResults,
    setting: Setting,
    *,
    name: str,
    metric: str,
    fields: tuple[str, ...] = ("bandwidth",),
) -> Parts:
    """Measure an estimator's mean error over sweeps minus that of each other estimator."""
    parts = {}
    for field in fields:
        error = _mean(m, field, name, setting, metric)
        for other in PAPER_ESTIMATORS:
            if other != name:
                label = f"{LABELS[name]} − {LABELS[other]}"
                label += f", over {_AXES[field]}" if len(fields) > 1 else ""
                reference = _mean(m, field, other, setting, metric)
                parts[label] = paired_difference(error, reference)
    return parts


_AXES = {"bandwidth": "CV segments", "epsilon": "ε", "delta": "δ"}


def percent_apart(
    m: PaperResults, setting: Setting, *, pairs: Sequence[tuple[str, str, str]]
) -> Parts:
    """Measure differences of mean errors over CV segments, each (estimator, reference, metric)."""
    return {
        f"{LABELS[a]} to {LABELS[b]}, {METRICS[metric][0]}": percent(
            _mean(m, "bandwidth", a, setting, metric), _mean(m, "bandwidth", b, setting, metric)
        )
        for a, b, metric in pairs
    }


def mhe_behind_ekf(m: PaperResults, setting: Setting) -> Parts:
    """Measure the MHE's speed error above the EKF's."""
    mhe, ekf = (_mean(m, "bandwidth", name, setting, SPEED) for name in ("mhe", "ekf"))
    return {"MHE − EKF": paired_difference(mhe, ekf)}


def enkf_rougher(m: PaperResults, setting: Setting) -> Parts:
    """Measure the roughness of the EnKF's density curve minus that of each other estimator."""
    rough = {
        name: roughness(m.curve("bandwidth", name, setting, DENSITY)) for name in PAPER_ESTIMATORS
    }
    return {
        f"EnKF − {LABELS[name]}": paired_difference(rough["enkf"], other)
        for name, other in rough.items()
        if name != "enkf"
    }


def _correlation(a: FloatArray, b: FloatArray) -> Interval:
    """Return the mean correlation of two curves (n_points, n), by Fisher's transformation."""
    # A perfect correlation would go to infinity.
    per_seed = np.clip(correlations(a, b), -1.0 + 1e-9, 1.0 - 1e-9)
    z = mean_interval(np.arctanh(per_seed))
    mean, low, high = (float(np.tanh(end)) for end in (z.mean, z.low, z.high))
    return Interval(mean, low, high, z.n)


def alike_over_epsilon(m: PaperResults, setting: Setting) -> Parts:
    """Measure the correlation of two estimators' density curves over epsilon."""
    curves = {name: m.curve("epsilon", name, setting, DENSITY) for name in PAPER_ESTIMATORS}
    return {
        f"{LABELS[a]}, {LABELS[b]}": _correlation(curves[a], curves[b])
        for a, b in combinations(PAPER_ESTIMATORS, 2)
    }


def speed_like_density(m: PaperResults, setting: Setting) -> Parts:
    """Measure the correlation of an estimator's density and speed curves."""
    return {
        f"{LABELS[name]}, over {_AXES[field]}": _correlation(
            m.curve(field, name, setting, DENSITY), m.curve(field, name, setting, SPEED)
        )
        for field in ("epsilon", "delta")
        for name in PAPER_ESTIMATORS
    }


def epsilon_matters_more(m: PaperResults, setting: Setting) -> Parts:
    """Measure the fall of the density error from end to end, over epsilon minus over delta."""
    parts = {}
    for name in PAPER_ESTIMATORS:
        epsilon, delta = (m.curve(field, name, setting, DENSITY) for field in ("epsilon", "delta"))
        fall = epsilon[0] - epsilon[-1], delta[0] - delta[-1]
        parts[LABELS[name]] = paired_difference(*fall)
    return parts


def growth(
    m: PaperResults,
    setting: Setting,
    *,
    field: str,
    low: float | None = None,
    high: float | None = None,
) -> Parts:
    """Measure the excess of the density error at one value of a sweep over a higher value [%].

    The values are the lowest and the highest of the sweep unless they are given.
    """
    values = m.design.sweeps[field]
    ends = values[0] if low is None else low, values[-1] if high is None else high
    return {
        LABELS[name]: percent(*(m.at(field, end, name, setting, DENSITY) for end in ends))
        for name in PAPER_ESTIMATORS
    }


def time_order(m: PaperResults, setting: Setting) -> Parts:
    """Measure the ratios of step times of neighbours in the paper's order."""
    order = ("ukf", "enkf", "mhe", "ekf")
    return {
        f"{LABELS[a]} / {LABELS[b]}": geometric_mean_interval(
            m.seconds(a, setting) / m.seconds(b, setting)
        )
        for a, b in pairwise(order)
    }


def above_baseline(m: PaperResults, setting: Setting, *, baseline: str, metric: str) -> Parts:
    """Measure every estimator's error minus a baseline's at the base point."""
    reference = m.base(baseline, setting, metric)
    return {
        f"{LABELS[name]} − {LABELS[baseline]}": paired_difference(
            m.base(name, setting, metric), reference
        )
        for name in PAPER_ESTIMATORS
    }
