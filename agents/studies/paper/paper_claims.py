"""The claims of the paper's results section, and the targets of this project.

Where the paper gives no number ("closely followed", "small", "similar"), the bound is ours, fixed
before the full run, after a look at three traffic seeds.
"""

from __future__ import annotations

from agents.experiments.cells import DENSITY, SPEED
from agents.studies.paper.claims import ABOVE_ZERO, BELOW_ZERO, Claim, ExpectedRange
from agents.studies.paper.measures import (
    against_others,
    alike_over_epsilon,
    below,
    enkf_rougher,
    epsilon_matters_more,
    falls,
    growth,
    mhe_behind_ekf,
    percent_apart,
    speed_like_density,
    time_order,
)
from agents.studies.paper.plan import EPSILON

CLOSE = 5.0
"""Two errors are close if they differ by less than this [%]."""
SMALL = 10.0
"""A variation is small if it is less than this [%]."""
SIMILAR = 0.9
"""Two curves are similar if they correlate by more than this."""

_OVER_CV = "mean over the numbers of CV segments"
_APART = f"relative difference of the RMSE, {_OVER_CV}"

CLAIMS = (
    Claim(
        "P1", "The density error of every technique falls with more CV segments.",
        "least-squares slope of the density RMSE over the number of CV segments",
        "veh/km a segment", BELOW_ZERO, falls(DENSITY),
    ),
    Claim(
        "P2", "The speed error of every technique falls with more CV segments.",
        "least-squares slope of the speed RMSE over the number of CV segments",
        "km/h a segment", BELOW_ZERO, falls(SPEED),
    ),
    Claim(
        "P3", "UKF performs best in density.",
        f"difference of density RMSE, {_OVER_CV}", "veh/km", BELOW_ZERO,
        against_others("ukf", DENSITY, "bandwidth"),
    ),
    Claim(
        "P4", "UKF performs best in speed.",
        f"difference of speed RMSE, {_OVER_CV}", "km/h", BELOW_ZERO,
        against_others("ukf", SPEED, "bandwidth"),
    ),
    Claim(
        "P5", "EnKF performs worst in density.",
        f"difference of density RMSE, {_OVER_CV}", "veh/km", ABOVE_ZERO,
        against_others("enkf", DENSITY, "bandwidth"),
    ),
    Claim(
        "P6", "EnKF performs worst in speed.",
        f"difference of speed RMSE, {_OVER_CV}", "km/h", ABOVE_ZERO,
        against_others("enkf", SPEED, "bandwidth"),
    ),
    Claim(
        "P7", "In density, MHE and EKF follow UKF closely.",
        _APART, "%", ExpectedRange(-CLOSE, CLOSE),
        percent_apart(("mhe", "ukf", DENSITY), ("ekf", "ukf", DENSITY)),
    ),
    Claim(
        "P8", "In speed, EKF follows UKF closely.",
        _APART, "%", ExpectedRange(-CLOSE, CLOSE), percent_apart(("ekf", "ukf", SPEED)),
    ),
    Claim(
        "P9", "MHE falls behind EKF in speed.",
        f"difference of speed RMSE, {_OVER_CV}", "km/h", ABOVE_ZERO, mhe_behind_ekf,
    ),
    Claim(
        "P10", "EKF and MHE perform comparably.",
        _APART, "%", ExpectedRange(-CLOSE, CLOSE),
        percent_apart(("mhe", "ekf", DENSITY), ("mhe", "ekf", SPEED)),
    ),
    Claim(
        "P11", "EnKF's error varies more from one number of CV segments to the next.",
        "difference of the mean size of second differences of the density RMSE along the curve",
        "veh/km", ABOVE_ZERO, enkf_rougher,
    ),
    Claim(
        "P12", "UKF performs best in density under other ε and δ, too.",
        "difference of density RMSE, mean over the values of ε and of δ", "veh/km", BELOW_ZERO,
        against_others("ukf", DENSITY, "epsilon", "delta"),
    ),
    Claim(
        "P13", "EnKF performs worst in density under other ε and δ, too.",
        "difference of density RMSE, mean over the values of ε and of δ", "veh/km", ABOVE_ZERO,
        against_others("enkf", DENSITY, "epsilon", "delta"),
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
        ExpectedRange(-SMALL, SMALL), growth("delta", None, None),
    ),
    Claim(
        "P18", "The variation is small for ε above 1.",
        "excess of the density RMSE at ε = 1 over that at the highest ε", "%",
        ExpectedRange(-SMALL, SMALL), growth("epsilon", EPSILON, None),
    ),
    Claim(
        "P19", "The error worsens quickly as ε goes from 1 towards 0.",
        "excess of the density RMSE at the lowest ε over that at ε = 1", "%",
        ExpectedRange(low=SMALL), growth("epsilon", None, EPSILON),
    ),
    Claim(
        "P20", "A step takes UKF the least time, then EnKF, MHE and EKF.",
        "ratio of the times of a step", "1", ExpectedRange(high=1.0), time_order,
    ),
)  # fmt: skip
"""Claims of the paper's section on results, in its order."""

PROJECT_TARGETS = (
    Claim(
        "T1", "Every estimator beats the random walk in density.",
        "difference of density RMSE at the base point", "veh/km", BELOW_ZERO,
        below("random_walk", DENSITY),
    ),
    Claim(
        "T2", "Every estimator beats the random walk in speed.",
        "difference of speed RMSE at the base point", "km/h", BELOW_ZERO,
        below("random_walk", SPEED),
    ),
    Claim(
        "T3", "Every estimator beats the open loop in density.",
        "difference of density RMSE at the base point", "veh/km", BELOW_ZERO,
        below("open_loop", DENSITY),
    ),
    Claim(
        "T4", "Every estimator beats the open loop in speed.",
        "difference of speed RMSE at the base point", "km/h", BELOW_ZERO,
        below("open_loop", SPEED),
    ),
)  # fmt: skip
"""Targets of this project for its estimators."""
