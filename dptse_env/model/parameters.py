"""Parameters of the ARZ model, and the named sets that ship with the package."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import (
    Interval,
    check_object,
    checked_fields,
    from_mapping,
    parse_json,
    read_json,
    require_name,
    within,
)

LARGEST_W = 1.1
"""Largest w of a physical state, in units of v_f."""

Bounds = Literal["cone", "box"]

# The cone of physical states: 1 veh/km <= rho <= rho_m, v >= 0 and 0.4 v_f <= w <= 1.1 v_f. The
# lower bound on w excludes standing traffic in nearly empty cells, where the supply depends on the
# state as w / rho, which makes filters diverge.
LEAST_DENSITY = 1.0
LEAST_W = 0.4
# Share of the jam density below which a measurement treats the density as constant: dv/drho grows
# as psi / rho^2, which makes filters diverge.
MEASUREMENT_FLOOR = 0.01
# Bounds on the factors of demand states.
LEAST_FACTOR, LARGEST_FACTOR = 0.1, 3.0
# Below this share of its jam density a cell is a vacuum: its demand is zero and its w is v_f.
VACUUM = 1e-12
# A speed of zero is a kink, and projected states may lie on it. Within this share of v_f the
# derivative of moving traffic is used (and that of the mainline where both branches of a diverge
# stand), so that it does not depend on rounding.
STANDING = 1e-9


@dataclass(frozen=True)
class ARZParameters:
    """Parameters of the pressure `p(rho) = v_f (rho / rho_m)^gamma` and of the relaxation.

    Attributes:
        name: Name of the set in tables and messages.
        free_flow_speed: v_f [km/h]; also the w that drivers relax towards.
        jam_density: rho_m [veh/km] of a road of `lanes` lanes; other cells scale with their lanes.
        gamma: Exponent of the pressure [-]; fits of real traffic may be as low as 0.4.
        relaxation_time: tau [s]; infinite for no relaxation.
        lanes: Lanes of the road to which `jam_density` applies.
        derived_from: Shipped set whose tuned estimator settings a set of one's own takes
            (`dptse_env.estimators.tuned.tuned_with`); None for the default one.

    Raises:
        ValueError: A value is out of range, or there is no such shipped set.
    """

    name: str
    free_flow_speed: Annotated[float, Interval(0.1, 1000)]
    jam_density: Annotated[float, Interval(0.01, 100_000)]
    gamma: Annotated[float, Interval(0.01, 100)]
    relaxation_time: Annotated[float, Interval(0, math.inf, open_low=True)]
    lanes: Annotated[int, Interval(1, 16)] = 3
    derived_from: str | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "parameters")
        if self.derived_from is not None:
            require_name("parameters.derived_from", self.derived_from, available_parameters())

    @property
    def is_own(self) -> bool:
        """True where they are a road's own, not a set that ships with the package."""
        return self.name not in available_parameters()

    def largest_time_step(self, segment_length: float) -> float:
        """Return the largest time step T [s] of the CFL condition for segments of a length [km].

        Forwards, no cell sends more than it holds: (T/l) w <= 1 - T/tau up to w = 1.1 v_f.
        Backwards, no wave crosses more than a cell; the fastest, gamma v_f, runs out of a jam.
        """
        crossing = HOUR * segment_length / self.free_flow_speed
        forwards = 1.0 / (LARGEST_W / crossing + 1.0 / self.relaxation_time)
        return min(forwards, crossing / self.gamma)

    def shortest_segment(self, time_step: float) -> float:
        """Return the least length of segments [km] on which the CFL condition has a time step [s].

        It is rounded up to 0.1 m, and infinite where no segment is long enough.
        """
        share = 1.0 - time_step / self.relaxation_time
        if not (time_step > 0.0 and share > 0.0):
            return math.inf
        waves = max(LARGEST_W / share, self.gamma) * self.free_flow_speed
        return math.ceil(1e4 * time_step * waves / HOUR) / 1e4

    def require_time_step(
        self, time_step: float, length: float, field: str = "segment_length"
    ) -> None:
        """Refuse a time step [s] that violates the CFL condition on a segment [km].

        Args:
            time_step: The time step.
            length: The length of the segment.
            field: The field of the corridor that has this length.

        Raises:
            ValueError: It does; the message has the shortest segment of this time step, if any.
        """
        largest = self.largest_time_step(length)
        if 0.0 < time_step <= largest:
            return
        # Rounded so that the numbers in the message are admissible.
        named = math.floor(100.0 * largest) / 100.0
        least = self.shortest_segment(time_step)
        allowed = f"at least {least:g} km" if math.isfinite(least) else "longer"
        raise ValueError(
            f"corridor.{field} must be {allowed} for the parameters {self.name!r}, got "
            f"{length:g} km: there their CFL condition needs a time step > 0 and at most "
            f"{named:.2f} s, got {time_step:g} s"
        )


@cache
def _shipped() -> dict[str, str]:
    entries = sorted((files("dptse_env.model") / "sets").iterdir(), key=lambda entry: entry.name)
    return {
        entry.name.removesuffix(".json"): entry.read_text(encoding="utf-8")
        for entry in entries
        if entry.name.endswith(".json")
    }


def available_parameters() -> tuple[str, ...]:
    """Names of the sets that ship with the package, sorted."""
    return tuple(_shipped())


@cache
def load_parameters(name: str) -> ARZParameters:
    """Load a set that ships with the package.

    Raises:
        ValueError: There is no such set; the message lists the available ones.
    """
    require_name("parameters", name, available_parameters())
    return _parse(parse_json(_shipped()[name], name), name)


def read_parameters(path: str | Path) -> ARZParameters:
    """Read a set from a JSON file, as written by `write_parameters`.

    Raises:
        ValueError: The file cannot be read, has another format, or a value is out of range; the
            message starts with the path of the file.
    """
    return _parse(read_json(path), str(path))


def write_parameters(
    path: str | Path, parameters: ARZParameters, provenance: Mapping[str, Any]
) -> None:
    """Write a set and its provenance (data, method, errors) as JSON."""
    content = {"parameters": asdict(parameters), "provenance": dict(provenance)}
    Path(path).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _parse(content: Any, path: str) -> ARZParameters:
    checked = check_object(content, path, {"parameters": dict, "provenance": dict})
    with within(f"{path}: "):
        return from_mapping(ARZParameters, checked["parameters"], "parameters")
