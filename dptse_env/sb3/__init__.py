"""Learning with stable-baselines3 on many episodes at once; needs the extra ``train``."""

from dptse_env.policies import shipped_policies

try:
    from dptse_env.sb3.channels import RoadChannels
    from dptse_env.sb3.fit import TrainedOn
    from dptse_env.sb3.plackett_luce import PlackettLuce
    from dptse_env.sb3.policy import PlackettLucePolicy
    from dptse_env.sb3.saved import SavedPolicy, load_policy, save_policy
    from dptse_env.sb3.vec_env import SB3VecEnv
except ModuleNotFoundError as problem:
    missing = (problem.name or "").partition(".")[0]
    if missing not in ("torch", "stable_baselines3"):
        raise
    raise ImportError(
        f"dptse_env.sb3 needs PyTorch and stable-baselines3, and {missing} is not installed: "
        "pip install 'dptse-env[train]'"
    ) from problem

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
