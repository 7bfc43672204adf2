"""Parameters of the ARZ model: validated values and the named sets that ship with the package."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any

from dptse_env.validation import integer, positive

_SETS = resources.files("dptse_env.model") / "sets"


@dataclass(frozen=True)
class ARZParameters:
    """Parameters of the pressure `p(rho) = v_f (rho / rho_m)^gamma` and of the relaxation.

    Attributes:
        name: What the set is called in tables and messages.
        free_flow_speed: v_f [km/h]; also the w that drivers relax towards.
        jam_density: rho_m [veh/km] of a road of `lanes` lanes; other cells scale with their lanes.
        gamma: Exponent of the pressure [-]; any positive value, fits of real traffic reach 0.4.
        relaxation_time: tau [s]; infinite for no relaxation.
        lanes: Lanes of the road that `jam_density` is for.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    name: str
    free_flow_speed: float
    jam_density: float
    gamma: float
    relaxation_time: float
    lanes: int = 3

    def __post_init__(self) -> None:
        """Refuse values without physical meaning."""
        for field in ("free_flow_speed", "jam_density", "gamma", "relaxation_time"):
            value = getattr(self, field)
            if field == "relaxation_time" and value == math.inf:
                continue
            object.__setattr__(self, field, positive(f"parameters.{field}", value))
        object.__setattr__(self, "lanes", integer("parameters.lanes", self.lanes, 1))

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> ARZParameters:
        """Build from a mapping of field names; unknown and missing keys are refused by name."""
        known = {field.name for field in fields(cls)}
        for key in mapping:
            if key not in known:
                raise ValueError(
                    f"parameters.{key} is unknown, allowed are {', '.join(sorted(known))}"
                )
        for key in sorted(known - {"lanes"}):
            if key not in mapping:
                raise ValueError(f"parameters.{key} is missing")
        return cls(**mapping)


def available_parameters() -> tuple[str, ...]:
    """Names of the sets that ship with the package, sorted."""
    names = (entry.name for entry in _SETS.iterdir())
    return tuple(sorted(name.removesuffix(".json") for name in names if name.endswith(".json")))


def load_parameters(name: str) -> ARZParameters:
    """Load a set that ships with the package.

    Raises:
        ValueError: if there is no such set; the message lists those there are.
    """
    if name not in available_parameters():
        raise ValueError(
            f"parameters must be one of {', '.join(available_parameters())}, got {name!r}"
        )
    return _parse(_SETS.joinpath(f"{name}.json").read_text(encoding="utf-8"))


def read_parameters(path: str | Path) -> ARZParameters:
    """Read a set from a JSON file of the shape that `write_parameters` leaves."""
    return _parse(Path(path).read_text(encoding="utf-8"))


def write_parameters(
    path: str | Path, parameters: ARZParameters, provenance: Mapping[str, Any]
) -> None:
    """Write a set and where it comes from (data, method, errors reached) as JSON."""
    content = {"parameters": asdict(parameters), "provenance": dict(provenance)}
    Path(path).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _parse(text: str) -> ARZParameters:
    content = json.loads(text)
    if not isinstance(content, dict) or not isinstance(content.get("parameters"), dict):
        raise ValueError("a parameter file must be a JSON object with the key 'parameters'")
    return ARZParameters.from_mapping(content["parameters"])
