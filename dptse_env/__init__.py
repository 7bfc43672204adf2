"""Choose which connected vehicles to query when estimating traffic under differential privacy.

Importing the package registers its environments with Gymnasium::

    import gymnasium as gym

    env = gym.make("dptse_env:dptse/PaperHighway-v0")

The module prefix makes the id known in subprocesses too. `evaluate` plays whole episodes of a
query policy::

    rows = dptse_env.evaluate(env, "shift-ahead", seeds=range(64))

`RoadEstimator` runs an estimator on a stream of one's own.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dptse_env.registration import register_environments, register_part
from dptse_env.versions import __version__

if TYPE_CHECKING:
    from dptse_env.evaluation import evaluate
    from dptse_env.measurement.seen import Seen, probes, station
    from dptse_env.road_estimator import RoadEstimator

__all__ = [
    "RoadEstimator",
    "Seen",
    "__version__",
    "evaluate",
    "probes",
    "register_environments",
    "register_part",
    "station",
]

register_environments()


_LATER = {
    "RoadEstimator": "road_estimator",
    "Seen": "measurement.seen",
    "evaluate": "evaluation",
    "probes": "measurement.seen",
    "station": "measurement.seen",
}
"""Modules of what is imported at its first use: registering ids is quick, environments are not."""


def __getattr__(name: str) -> Any:
    """Import what `_LATER` names."""
    if name in _LATER:
        return getattr(import_module(f"dptse_env.{_LATER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
