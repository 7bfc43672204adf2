"""The protected unit of a configuration, as the adversary reads it from the public settings."""

from __future__ import annotations

from dptse_env.config import EnvConfig
from dptse_env.release import CappedSettings


def replaces(config: EnvConfig) -> bool:
    """Return whether adjacent records differ in a vehicle replaced by another, or in one more."""
    privacy = config.privacy
    return not isinstance(privacy, CappedSettings) or privacy.adjacency == "replace"


def protects_seconds(config: EnvConfig) -> bool:
    """Return whether a single second of a trip is protected, not the trip."""
    privacy = config.privacy
    return isinstance(privacy, CappedSettings) and privacy.unit == "event"


def contribution_cap(config: EnvConfig) -> int:
    """Return in how many queried steps of an episode a vehicle counts at most."""
    privacy = config.privacy
    cap = privacy.contribution_cap if isinstance(privacy, CappedSettings) else None
    return cap or config.horizon_steps
