"""The claims of the paper's results section, and the targets of this project.

Where the paper gives no number ("closely followed", "small", "similar"), the bound is ours, fixed
before the full run, after a look at three traffic seeds.
"""

from __future__ import annotations

from functools import partial
from itertools import product

from agents.experiments.cells import DENSITY, METRICS, SPEED
from agents.figures import LABELS
from agents.studies.paper.claims import ABOVE_ZERO, BELOW_ZERO, Claim, ExpectedRange
from agents.studies.paper.measures import (
    above_baseline,
    against_rest,
    alike_over_epsilon,
    enkf_rougher,
    epsilon_matters_more,
    falls,
    growth,
    mhe_behind_ekf,
    percent_apart,
    speed_like_density,
    time_order,
)
from agents.studies.paper.plan import BASELINE_ESTIMATORS, EPSILON

CLOSE = 5.0
"""Two errors are close if they differ by less than this [%]."""
SMALL = 10.0
"""A variation is small if it is less than this [%]."""
SIMILAR = 0.9
"""Two curves are similar if they correlate by more than this."""

_OVER_CV = "mean over the numbers of CV segments"
_APART = f"relative difference of the RMSE, {_OVER_CV}"

CLAIMS = (
    *(
        Claim(
            f"P{k}", f"The {name} error of every technique falls with more CV segments.",
            f"least-squares slope of the {name} RMSE over the number of CV segments",
            f"{unit} a segment", BELOW_ZERO, partial(falls, metric=metric),
        )
        for k, (metric, (name, unit)) in enumerate(METRICS.items(), start=1)
    ),
    *(
        Claim(
            f"P{k}", f"{LABELS[estimator]} performs {rank} in {METRICS[metric][0]}.",
            f"difference of {METRICS[metric][0]} RMSE, {_OVER_CV}", METRICS[metric][1], expected,
            partial(against_rest, name=estimator, metric=metric),
        )
        for k, (estimator, rank, expected, metric) in enumerate(
            (
                ("ukf", "best", BELOW_ZERO, DENSITY), ("ukf", "best", BELOW_ZERO, SPEED),
                ("enkf", "worst", ABOVE_ZERO, DENSITY), ("enkf", "worst", ABOVE_ZERO, SPEED),
            ),
            start=3,
        )
    ),
    Claim(
        "P7", "In density, MHE and EKF follow UKF closely.",
        _APART, "%", ExpectedRange(-CLOSE, CLOSE),
        partial(percent_apart, pairs=(("mhe", "ukf", DENSITY), ("ekf", "ukf", DENSITY))),
    ),
    Claim(
        "P8", "In speed, EKF follows UKF closely.", _APART, "%", ExpectedRange(-CLOSE, CLOSE),
        partial(percent_apart, pairs=(("ekf", "ukf", SPEED),)),
    ),
    Claim(
        "P9", "MHE falls behind EKF in speed.",
        f"difference of speed RMSE, {_OVER_CV}", "km/h", ABOVE_ZERO, mhe_behind_ekf,
    ),
    Claim(
        "P10", "EKF and MHE perform comparably.", _APART, "%", ExpectedRange(-CLOSE, CLOSE),
        partial(percent_apart, pairs=(("mhe", "ekf", DENSITY), ("mhe", "ekf", SPEED))),
    ),
    Claim(
        "P11", "EnKF's error varies more from one number of CV segments to the next.",
        "difference of the mean size of second differences of the density RMSE along the curve",
        "veh/km", ABOVE_ZERO, enkf_rougher,
    ),
    Claim(
        "P12", "UKF performs best in density under other ε and δ, too.",
        "difference of density RMSE, mean over the values of ε and of δ", "veh/km", BELOW_ZERO,
        partial(against_rest, name="ukf", metric=DENSITY, fields=("epsilon", "delta")),
    ),
    Claim(
        "P13", "EnKF performs worst in density under other ε and δ, too.",
        "difference of density RMSE, mean over the values of ε and of δ", "veh/km", ABOVE_ZERO,
        partial(against_rest, name="enkf", metric=DENSITY, fields=("epsilon", "delta")),
    ),
    Claim(
        "P14", "All techniques vary similarly with privacy.",
        "correlation of the density RMSE of two techniques along ε", "1",
        ExpectedRange(low=SIMILAR), alike_over_epsilon,
    ),
    Claim(
        "P15", "The speed error varies with ε and δ as the density error does.",
        "correlation of the density and the speed RMSE along ε and along δ", "1",
        ExpectedRange(low=SIMILAR), speed_like_density,
    ),
    Claim(
        "P16", "ε has more influence than δ.",
        "density RMSE at the lowest minus at the highest value: that of ε minus that of δ",
        "veh/km", ABOVE_ZERO, epsilon_matters_more,
    ),
    Claim(
        "P17", "The variation is small over the full range of δ.",
        "excess of the density RMSE at the lowest δ over that at the highest", "%",
        ExpectedRange(-SMALL, SMALL), partial(growth, field="delta"),
    ),
    Claim(
        "P18", "The variation is small for ε above 1.",
        "excess of the density RMSE at ε = 1 over that at the highest ε", "%",
        ExpectedRange(-SMALL, SMALL), partial(growth, field="epsilon", low=EPSILON),
    ),
    Claim(
        "P19", "The error worsens quickly as ε goes from 1 towards 0.",
        "excess of the density RMSE at the lowest ε over that at ε = 1", "%",
        ExpectedRange(low=SMALL), partial(growth, field="epsilon", high=EPSILON),
    ),
    Claim(
        "P20", "A step takes UKF the least time, then EnKF, MHE and EKF.",
        "ratio of the times of a step", "1", ExpectedRange(high=1.0), time_order,
    ),
)  # fmt: skip
"""Claims of the paper's section on results, in its order."""

PROJECT_TARGETS = tuple(
    Claim(
        f"T{k}", f"Every estimator beats the {LABELS[baseline]} in {METRICS[metric][0]}.",
        f"difference of {METRICS[metric][0]} RMSE at the base point", METRICS[metric][1],
        BELOW_ZERO, partial(above_baseline, baseline=baseline, metric=metric),
    )
    for k, (baseline, metric) in enumerate(product(BASELINE_ESTIMATORS, METRICS), start=1)
)  # fmt: skip
"""Targets of this project for its estimators."""
