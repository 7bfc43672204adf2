"""Choose which connected vehicles to query when estimating traffic under differential privacy.

Importing the package registers its environments with Gymnasium::

    import gymnasium as gym

    env = gym.make("dptse_env:dptse/PaperHighway-v0")

The module prefix makes the id known in subprocesses too.
"""

from dptse_env.registration import register_environments, register_part

__all__ = ["register_environments", "register_part"]
__version__ = "0.2.0"

register_environments()
