"""Learning with stable-baselines3 on many episodes at once; needs the extra ``train``."""

from dptse_env.policies import shipped_policies
from dptse_env.utils.extras import needed_for

with needed_for("dptse_env.sb3"):
    from dptse_env.sb3.channels import RoadChannels
    from dptse_env.sb3.fit import TrainedOn
    from dptse_env.sb3.plackett_luce import PlackettLuce
    from dptse_env.sb3.policy import PlackettLucePolicy
    from dptse_env.sb3.saved import SavedPolicy, load_policy, save_policy
    from dptse_env.sb3.vec_env import SB3VecEnv

__all__ = [
    "PlackettLuce",
    "PlackettLucePolicy",
    "RoadChannels",
    "SB3VecEnv",
    "SavedPolicy",
    "TrainedOn",
    "load_policy",
    "save_policy",
    "shipped_policies",
]
