"""Registration: environment ids with Gymnasium, and names for the parts of other packages.

Entry points and registries are named by strings, so registering imports nothing heavy.
"""

from pkgutil import resolve_name
from typing import Any

from gymnasium.envs.registration import register, registry

ENVIRONMENTS = {
    "dptse/PaperHighway-v0": "paper-highway",
    "dptse/PrivateHighway-v1": "private-highway",
    "dptse/LongHighway-v0": "long-highway",
    "dptse/ShortHighway-v0": "short-highway",
}
"""Environment ids and the preset behind each."""

ENCODINGS = {"Discrete": "sequential", "Box": "scores", "Slots": "slots"}
"""Action encodings by the suffix that an id may have before its version, for programs that take an
id alone. An id without one has the mask, or what a road file says."""

REGISTRIES = {
    "action": "dptse_env.spaces.actions:ACTION_ENCODINGS",
    "corridor": "dptse_env.traffic:CORRIDORS",
    "estimator": "dptse_env.estimators:ESTIMATORS",
    "observation": "dptse_env.spaces.observations:BLOCKS",
    "privacy": "dptse_env.release:RELEASE_MODELS",
    "reward": "dptse_env.spaces.rewards:REWARDS",
    "schedule": "dptse_env.schedules:SCHEDULES",
}
"""Registries by the keyword that takes their names."""


def register_environments() -> None:
    """Register the ids with Gymnasium; calling it twice changes nothing."""
    for env_id, preset in ENVIRONMENTS.items():
        kwargs = {env_id: {"preset": preset}}
        for suffix, action in ENCODINGS.items():
            kwargs[encoded(env_id, suffix)] = {"preset": preset, "action": action}
        for own_id, own in kwargs.items():
            if own_id not in registry:
                register(
                    id=own_id,
                    entry_point="dptse_env.env:SensorQueryEnv",
                    vector_entry_point="dptse_env.vector_env:SensorQueryVectorEnv",
                    kwargs=own,
                )


def encoded(env_id: str, suffix: str) -> str:
    """Return the id of an environment with a suffix of `ENCODINGS`."""
    road, _, version = env_id.rpartition("-")
    return f"{road}-{suffix}-{version}"


def register_part(keyword: str, name: str, part: Any) -> None:
    """Register a part of another package under a name that a keyword accepts.

    The name is known in processes that make this call. For a name that is known everywhere, a
    package makes it in a function that it declares as an entry point of the group
    ``dptse_env.plugins``. ``"package.module:Name"`` needs no registration. Registering a part twice
    changes nothing.

    Args:
        keyword: One of `REGISTRIES`.
        name: Lower-case letters, digits, hyphens and underscores; none that is taken.
        part: The part, or ``"package.module:Name"``, which is imported when it is used.

    Raises:
        ValueError: The keyword is unknown, the name malformed or taken, or the part does not fit
            the keyword.
    """
    if keyword not in REGISTRIES:
        raise ValueError(f"keyword must be one of {', '.join(REGISTRIES)}, got {keyword!r}")
    resolve_name(REGISTRIES[keyword]).register(name, part)
