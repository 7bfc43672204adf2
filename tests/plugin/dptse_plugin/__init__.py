"""One part of every kind for dptse-env, as another project would bring it."""

from dptse_env import register_part

PARTS = {
    "action": "Neighbours",
    "corridor": "ROAD",
    "estimator": "Smoothed",
    "observation": "MeanDensity",
    "privacy": "LaplaceRelease",
    "reward": "cheap_queries",
    "schedule": "MostJammed",
}
"""Name of each part in `dptse_plugin.parts` by the keyword that takes it."""


def register() -> None:
    """Name the parts; the entry point of this package calls it."""
    for keyword, part in PARTS.items():
        register_part(keyword, f"plugin-{keyword}", f"dptse_plugin.parts:{part}")
