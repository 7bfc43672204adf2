"""How far one vehicle can move what is released: the L2 sensitivities of the transcript.

A transcript is everything released in one episode: at every step the density and the speed of each
observed segment. Its sensitivity is the largest L2 distance between the transcripts of two traffic
records that differ in one vehicle.
"""

import math
from dataclasses import dataclass

from dptse_env.privacy.reasons import VoidReason
from dptse_env.validation import integer, positive

__all__ = ["ReleaseSensitivity", "Sensitivity", "paper_sensitivity"]


@dataclass(frozen=True)
class ReleaseSensitivity:
    """Sensitivity of one of the released quantities over a whole episode.

    Attributes:
        quantity: what is released.
        unit: unit of the quantity, of `bound` and of the noise added to it.
        bound: L2 sensitivity, in `unit`.
    """

    quantity: str
    unit: str
    bound: float


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivities of all released quantities, and what they rest on.

    Attributes:
        releases: one for each released quantity, in the order of the last axis of a release.
        protects: whose data the two adjacent records differ in, and how.
        assumptions: the public numbers the bounds were computed from, by name with unit.
        void_reasons: why the bounds fail to hold, in the environment's own setting.
    """

    releases: tuple[ReleaseSensitivity, ...]
    protects: str
    assumptions: tuple[tuple[str, int | float], ...]
    void_reasons: tuple[VoidReason, ...] = ()


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
    relation (with exponent 1) times that. The void reasons say what this overlooks.

    Args:
        n_sensors: observed segments at a step: queried segments plus fixed sensors.
        average_dwell: average time on a segment, in released steps.
        segment_length: [km].
        free_flow_speed: [km/h].
        jam_density: of a mainline segment, all lanes [veh/km].

    Returns:
        Delta_rho = sqrt(2 n_sensors average_dwell) / segment_length [veh/km] and
        Delta_v = (free_flow_speed / jam_density) Delta_rho [km/h] (the paper, section III,
        "Sensitivity relations").

    Raises:
        ValueError: if an argument is not finite and above zero, or `n_sensors` is not whole.
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
        protects="one vehicle's trip, replaced by another",
        assumptions=(("n_sensors", n_sensors), ("average_dwell_steps", average_dwell)),
        void_reasons=("average_dwell", "adaptive_queries", "speed_sensitivity"),
    )
