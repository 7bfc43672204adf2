"""L2 sensitivities of the transcript: the largest change that one vehicle can cause.

A transcript is everything released in one episode: at every step the density and the speed, or the
flow, of each observed segment. Its sensitivity is the largest L2 distance between the transcripts
of two traffic records that differ in one vehicle.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from dptse_env.utils.validation import integer, positive

Adjacency = Literal["replace", "add_remove"]
"""Difference of adjacent records: a vehicle's data replaced by another's, or a vehicle added."""


@dataclass(frozen=True)
class ReleaseSensitivity:
    """Sensitivity of a released quantity over a complete episode.

    Attributes:
        quantity: name of the released quantity.
        unit: unit of the quantity, of `bound` and of the noise added to it.
        bound: L2 sensitivity, in `unit`.
    """

    quantity: str
    unit: str
    bound: float


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivities of all released quantities, with the assumptions behind them.

    Attributes:
        releases: one for each released quantity, in the order of the last axis of a release.
        assumptions: the public numbers the bounds were computed from, by name with unit.
        extremes: the bounds that can be attained together, each with one number for each release
            in its unit; empty where all bounds can be attained at once.
        contributions: C, released steps that a vehicle's data can enter; None if not bounded.
    """

    releases: tuple[ReleaseSensitivity, ...]
    assumptions: tuple[tuple[str, int | float], ...]
    extremes: tuple[tuple[float, ...], ...] = ()
    contributions: int | None = None

    def joint_mu(self, noise_std: Iterable[float]) -> float:
        """Parameter of all releases together: the L2 sensitivity over the noise's deviations."""
        stds = tuple(noise_std)
        extremes = self.extremes or (tuple(release.bound for release in self.releases),)
        return max(
            math.hypot(*(bound / std for bound, std in zip(bounds, stds, strict=True)))
            for bounds in extremes
        )


def paper_sensitivity(
    *,
    n_sensors: int,
    average_dwell: float,
    segment_length: float,
    free_flow_speed: float,
    jam_density: float,
) -> Sensitivity:
    """The paper's sensitivities of density and mean speed.

    The differing vehicle passes each of `n_sensors` static sensors once in either record, at
    different times, and stays for `average_dwell` steps. While it does, the density there differs
    by one vehicle over the segment's length, and the speed by the slope of the equilibrium
    relation (with exponent 1) times that. ``docs/privacy/proof.md`` lists the cases that this
    overlooks.

    Args:
        n_sensors: observed segments at a step: queried segments plus fixed sensors.
        average_dwell: average time on a segment, in released steps.
        segment_length: [km].
        free_flow_speed: [km/h].
        jam_density: jam density of a mainline segment, all lanes [veh/km].

    Returns:
        Delta_rho = sqrt(2 n_sensors average_dwell) / segment_length [veh/km] and
        Delta_v = (free_flow_speed / jam_density) Delta_rho [km/h] (the paper, section III,
        "Sensitivity relations").

    Raises:
        ValueError: An argument is not finite and above zero, or `n_sensors` is no integer.
    """
    n_sensors = integer("n_sensors", n_sensors, 1)
    average_dwell = positive("average_dwell", average_dwell)
    segment_length = positive("segment_length", segment_length)
    free_flow_speed = positive("free_flow_speed", free_flow_speed)
    jam_density = positive("jam_density", jam_density)

    density = math.sqrt(2.0 * n_sensors * average_dwell) / segment_length
    speed = free_flow_speed / jam_density * density
    return Sensitivity(
        releases=(
            ReleaseSensitivity("density", "veh/km", density),
            ReleaseSensitivity("speed", "km/h", speed),
        ),
        assumptions=(("n_sensors", n_sensors), ("average_dwell_steps", average_dwell)),
    )


def contribution_sensitivity(
    *,
    contributions: int,
    adjacency: Adjacency,
    segment_length: float,
    largest_speed: float,
) -> Sensitivity:
    """Sensitivities of density and centred flow for vehicles with bounded contributions.

    A vehicle is on one segment at a step. Under any policy both worlds have the same queries
    given the same releases, so a vehicle's data enters at most `contributions` released steps of
    one segment each. There it adds 1 / l to the density and (v - v_0) / l to the flow, with its
    speed v clipped to [0, v_max] and v_0 = v_max / 2: at most v_0 / l in size.

    One vehicle added: sqrt(C) times that. One vehicle replaced by another: the two may count on
    different segments, which gives sqrt(2 C) times that in both quantities; or on the same segments
    at opposite speeds: densities agree and flows differ by v_max / l, in all 2 sqrt(C) v_0 / l.

    Args:
        contributions: C, released steps that a vehicle's data can enter, >= 1.
        adjacency: difference of adjacent records.
        segment_length: l [km].
        largest_speed: v_max [km/h], a public constant that recorded speeds are clipped to.

    Raises:
        ValueError: A number is out of range.
    """
    # Adding or removing; a replaced vehicle is in both worlds, on two segments or on the same.
    c = math.sqrt(integer("contributions", contributions, 1))
    density = c / positive("segment_length", segment_length)
    flow = density * positive("largest_speed", largest_speed) / 2.0
    same_segment = 0.0
    if adjacency == "replace":
        same_segment = 2.0 * flow
        density, flow = math.sqrt(2.0) * density, math.sqrt(2.0) * flow
    return Sensitivity(
        releases=(
            ReleaseSensitivity("density", "veh/km", density),
            ReleaseSensitivity("flow", "veh/h", max(flow, same_segment)),
        ),
        assumptions=(
            ("contributions", contributions),
            ("segment_length_km", segment_length),
            ("largest_speed_km_h", largest_speed),
        ),
        extremes=((density, flow), (0.0, same_segment)),
        contributions=contributions,
    )
