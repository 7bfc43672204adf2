"""Reasons for which a guarantee of privacy is void, as listed in ``info["privacy"]``."""

from collections.abc import Mapping
from types import MappingProxyType

VOID_REASONS: Mapping[str, str] = MappingProxyType(
    {
        "not_stated": "the release model states no guarantee",
        "literal_variance": (
            "the noise has variance kappa^2 Delta where the theorem needs a standard deviation of "
            "kappa Delta; the result depends on the units"
        ),
        "average_dwell": (
            "the sensitivity takes the average time on a segment for a bound on it: slower "
            "vehicles are seen more often than it counts"
        ),
        "adaptive_queries": (
            "the sensitivity counts static sensors that a vehicle passes once; a set of queried "
            "segments that moves, or that a policy chooses, may follow a vehicle"
        ),
        "speed_sensitivity": (
            "the sensitivity of the mean speed follows from an equilibrium relation; a vehicle "
            "that is nearly alone on its segment changes the mean by far more"
        ),
        "boundary_inputs": (
            "the estimator is fed the true state of the boundary segments without noise"
        ),
        "releases_not_composed": (
            "density and speed together reveal more than the configured epsilon"
        ),
        "truth_in_info": "info['truth'] shows the true traffic and what each vehicle contributed",
    }
)
"""Reasons with an explanation each, in the order of reports."""
