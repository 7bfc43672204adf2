"""Fit of a saved policy and an environment: properties that must agree, and allowed differences."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from dptse_env.config import PRESETS, EnvConfig
from dptse_env.parts import make_interface
from dptse_env.policies import TRANSFERABLE
from dptse_env.sb3.channels import RoadChannels
from dptse_env.sb3.kinds import Kind
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.traffic import Corridor

POLICY_FORMAT = "dptse-policy-1"
"""Format of policy files; its number is raised when saved weights change their meaning."""


PLAIN = "single segments"
"""Queries that are allowed where a card says nothing about them."""


@dataclass(frozen=True)
class TrainedOn:
    """The road that a policy was trained on.

    Attributes:
        corridor: Name of the corridor.
        n_mainline: Number of mainline segments.
        lanes: Lanes of the mainline, at its widest; None where an old card does not have them.
        segment_length: Length of the shortest segment [km]; None where an old card has none.
    """

    corridor: str
    n_mainline: int
    lanes: int | None
    segment_length: float | None

    @classmethod
    def from_corridor(cls, corridor: Corridor) -> TrainedOn:
        """Describe a corridor."""
        shortest = min(corridor.segment_lengths[: corridor.n_mainline])
        return cls(corridor.name, corridor.n_mainline, corridor.most_lanes, shortest)

    @classmethod
    def from_card(cls, card: Mapping[str, Any]) -> TrainedOn:
        """Return the description on a card.

        Cards of version 0.1 have only the name and the digest of the corridor, and the sizes of
        observation blocks.

        Raises:
            ValueError: The card has no such description.
        """
        fits, described = card["fits"], card.get("trained_on")
        if described is None:
            for config in PRESETS.values():
                if config.corridor.digest == fits["corridor"]:
                    return cls.from_corridor(config.corridor)
            size = re.search(r"\bage:(\d{1,6})\b", fits["observation"])
            if size is not None and _is_name(card["corridor"]):
                return cls(card["corridor"], int(size[1]), None, None)
        match described:
            case {
                "corridor": str(name),
                "n_mainline": int(n_mainline),
                "lanes": int(lanes),
                "segment_length": float(length),
            } if _is_name(name):
                return cls(name, n_mainline, lanes, length)
        raise ValueError("its card does not describe the road that it was trained on")

    def __str__(self) -> str:
        """Return the name and the sizes in words."""
        length = "" if self.segment_length is None else f" of {self.segment_length:g} km"
        lanes = "" if self.lanes is None else f", {self.lanes} lanes"
        return f"{self.corridor} ({self.n_mainline} mainline segments{length}{lanes})"


def make_fit(config: EnvConfig, kind: Kind) -> dict[str, Any]:
    """Return the properties that a policy for ``config`` must fit, as plain JSON."""
    encoding = make_interface(config).observations
    sizes = [f"{name}:{place.stop - place.start}" for name, place in encoding.slices.items()]
    fit: dict[str, Any] = {
        "format": POLICY_FORMAT,
        "observation": " ".join(sizes),
        "action": ACTION_ENCODINGS.name_of(config.action),
        "corridor": config.corridor.digest,
        "bandwidth": config.bandwidth,
    }
    if not config.queries.are_plain:
        fit["queries"] = _queries(config)
    if kind.is_shared:
        fit["channels"] = [channel.name for channel in RoadChannels.from_config(config).channels]
    return fit


def check_fit(
    card: Mapping[str, Any], kind: Kind, config: EnvConfig, allow: Collection[str]
) -> None:
    """Refuse a policy that does not fit an environment.

    Raises:
        ValueError: A property outside `allow` differs; the message names the values of both.
    """
    there, here = card["fits"], make_fit(config, kind)
    values = {key: (there[key], here[key]) for key in ("format", "action", "bandwidth")}
    values["queries"] = there.get("queries", PLAIN), here.get("queries", PLAIN)
    problems = {key: _difference(key, a, b) for key, (a, b) in values.items() if a != b}
    channels = _channel_difference(there, here) if kind.is_shared else ""
    if channels:
        problems["channels"] = channels
    elif there["observation"] != here["observation"]:
        # For a shared network, another number of segments is a matter of the corridor.
        key = "corridor" if kind.is_shared else "observation"
        problems[key] = _difference("observation", there["observation"], here["observation"])
        if not kind.is_shared:
            problems[key] += ", and a perceptron is tied to the observation it was trained on"
    if there["corridor"] != here["corridor"]:
        problems["corridor"] = _difference(
            "corridor",
            f"{TrainedOn.from_card(card)}, traffic {there['corridor']:.8}",
            f"{TrainedOn.from_corridor(config.corridor)}, traffic {here['corridor']:.8}",
        )
    refused = {key: text for key, text in problems.items() if key not in allow}
    if refused:
        hint = ""
        if all(key in TRANSFERABLE for key in refused):
            hint = f"; to transfer it on purpose, allow {' and '.join(sorted(refused))}"
        raise ValueError("; ".join(refused.values()) + hint)


def _queries(config: EnvConfig) -> str:
    """Return the options that can be queried, other than the mainline segments, in words."""
    return f"{config.queries}, bandwidth_unit {config.bandwidth_unit!r}"


def _difference(key: str, there: object, here: object) -> str:
    return f"{key} is {there!r} for the policy and {here!r} for the environment"


def _channel_difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Describe the channels that two roads do not share, of any sizes; empty without any."""
    if "channels" in there:
        channels = there["channels"], here["channels"]
    else:
        # Cards of version 0.1. The number of channels is checked with the weights.
        channels = _blocks(there), _blocks(here)
    if channels[0] == channels[1]:
        return ""
    if not isinstance(channels[0], list) or not all(isinstance(c, str) for c in channels[0]):
        raise ValueError("field 'fits.channels' of its card must be a list of names")
    only = [sorted(set(a) - set(b)) for a, b in (channels, channels[::-1])]
    return f"channels {only[0]!r:.300} are of the policy alone and {only[1]} of the environment"


def _blocks(fit: Mapping[str, Any]) -> list[str]:
    """Return the names of observation blocks, without their sizes."""
    return [part.partition(":")[0] for part in fit["observation"].split()]


def _is_name(text: str) -> bool:
    return len(text) <= 100 and text.isprintable()
