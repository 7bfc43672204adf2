"""PPO of stable-baselines3, which learns to query better than the best rule.

pip install -e '.[train]'
python examples/sb3_ppo.py --steps 3000000

`SB3VecEnv` steps a hundred episodes at once in one process. After three million steps, some minutes
on one core, the policy was 8 % below the best rule (88.0 and 95.7) on traffic that it never met.
`VecNormalize` scales observations by running statistics, and without it PPO ends near the rule. A
policy needs the statistics of its training wherever it acts.
"""

import gymnasium as gym
import numpy as np
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import dptse_env
from dptse_env.sb3 import SB3VecEnv

ENV, KEYWORDS = "dptse_env:dptse/ShortHighway-v0", {"bandwidth": 1, "action": "slots"}
N_ENVS, GAMMA = 128, 0.9  # a query matters for some ten seconds
HELD_OUT = range(1000, 1008)


class Normalised:
    """A model with the statistics of its observations: what `dptse_env.evaluate` asks for."""

    def __init__(self, model: PPO, statistics: VecNormalize) -> None:
        """Take both."""
        self.model, self.statistics = model, statistics

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        """Return actions and no state."""
        scaled = self.statistics.normalize_obs(observation)
        return self.model.predict(scaled, state, episode_start, deterministic)


def error(policy) -> float:
    """Return the error x 1000 on held-out traffic of a policy, or of a schedule by its name."""
    env = gym.make_vec(ENV, num_envs=len(HELD_OUT), traffic_seeds=list(HELD_OUT), **KEYWORDS)
    return -1000 * np.mean([row["reward"] for row in dptse_env.evaluate(env, policy, HELD_OUT)])


def main(steps: int = 300_000, seed: int = 0) -> None:
    """Train, and compare the policy with its untrained self and a rule on held-out traffic."""
    # Short episodes that begin anywhere in the records: every update sees all of their seconds.
    envs = gym.make_vec(
        ENV, num_envs=N_ENVS, autoreset_mode="SameStep", horizon=120, random_start=True, **KEYWORDS
    )
    statistics = VecNormalize(SB3VecEnv(envs), gamma=GAMMA)
    model = PPO(
        "MlpPolicy", statistics, n_steps=64, batch_size=1024, n_epochs=4, learning_rate=5e-4,
        gamma=GAMMA, gae_lambda=0.9, ent_coef=0.005, policy_kwargs={"net_arch": [64, 64]},
        seed=seed, device="cpu", verbose=1,
    )  # fmt: skip
    policy = Normalised(model, statistics)
    untrained = error(policy)
    model.learn(steps)
    trained, rule = error(policy), error("speed-front")
    print(f"error x 1000: untrained {untrained:.1f}, trained {trained:.1f}, rule {rule:.1f}")


if __name__ == "__main__":
    tyro.cli(main)
