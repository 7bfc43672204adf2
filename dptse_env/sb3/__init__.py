"""Learning with stable-baselines3 on many episodes at once; needs the extra ``train``."""

from dptse_env.policies import shipped_policies
from dptse_env.utils.registry import needed_for

with needed_for("dptse_env.sb3"):
    from dptse_env.sb3.acting import ActingPolicy
    from dptse_env.sb3.plackett_luce import PlackettLuce
    from dptse_env.sb3.road_policy import RoadChannels, RoadPolicy
    from dptse_env.sb3.saved import load_policy, save_policy
    from dptse_env.sb3.vec_env import ReplicaBaseline, SB3VecEnv

__all__ = [
    "ActingPolicy",
    "PlackettLuce",
    "ReplicaBaseline",
    "RoadChannels",
    "RoadPolicy",
    "SB3VecEnv",
    "load_policy",
    "save_policy",
    "shipped_policies",
]
