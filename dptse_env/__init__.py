"""Choose which connected vehicles to query when estimating traffic under differential privacy.

Importing the package registers its environments with Gymnasium::

    import gymnasium as gym

    env = gym.make("dptse_env:dptse/PaperHighway-v0")

The module prefix makes the id known in subprocesses too. `evaluate` plays whole episodes of a
query policy::

    rows = dptse_env.evaluate(env, "shift-ahead", seeds=range(64))
"""

from typing import TYPE_CHECKING, Any

from dptse_env.registration import register_environments, register_part
from dptse_env.versions import __version__

if TYPE_CHECKING:
    from dptse_env.evaluation import evaluate

__all__ = ["__version__", "evaluate", "register_environments", "register_part"]

register_environments()


def __getattr__(name: str) -> Any:
    """Import `evaluate` at its first use: registering ids is quick, environments are not."""
    if name == "evaluate":
        from dptse_env.evaluation import evaluate  # noqa: PLC0415

        return evaluate
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
