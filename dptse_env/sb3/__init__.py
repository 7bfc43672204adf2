"""What stable-baselines3 needs to learn on many episodes at once. Needs the extra ``train``."""

from dptse_env.sb3.vec_env import SB3VecEnv

__all__ = ["SB3VecEnv"]
