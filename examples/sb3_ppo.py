"""PPO of stable-baselines3, which learns to query better than the best rule.

pip install -e '.[train]'
python examples/sb3_ppo.py --steps 3000000

Without ``--steps`` it trains a tenth of that, in a tenth of the time.

`SB3VecEnv` steps a hundred episodes at once in one process, groups of eight of them with the same
traffic and noise, so that `ReplicaBaseline` can compare their queries. `VecNormalize` scales
observations by running statistics, without which a perceptron ends near the rule; they are saved
with its weights in results/examples/sb3_ppo.safetensors, which ``dptse evaluate --policies`` plays.
The encoding ``slots`` suits PPO: one categorical choice for each query.
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import dptse_env
from dptse_env.sb3 import ReplicaBaseline, SB3VecEnv, load_policy, save_policy

ENV = "dptse_env:dptse/ShortHighway-v0"
KEYWORDS = {"estimator": "ekf", "parameters": "published", "action": "slots"}
FILE, HELD_OUT = Path("results/examples/sb3_ppo.safetensors"), list(range(1000, 1008))


def main(steps: int = 300_000, seed: int = 0) -> None:
    """Train, and compare the policy with its untrained self and a rule on held-out traffic."""
    # Short episodes that begin anywhere in the records: every update sees all of their seconds.
    envs = gym.make_vec(
        ENV, num_envs=128, autoreset_mode="SameStep", horizon=120, random_start=True, **KEYWORDS
    )
    scaled = VecNormalize(SB3VecEnv(envs, replicas=8), gamma=0.9)
    model = PPO(  # a query matters for some ten seconds, hence gamma
        "MlpPolicy", scaled, n_steps=64, batch_size=1024, n_epochs=4, learning_rate=5e-4,
        gamma=0.9, gae_lambda=0.9, ent_coef=0.005, policy_kwargs={"net_arch": [64, 64]},
        seed=seed, device="cpu", verbose=1,
    )  # fmt: skip
    FILE.parent.mkdir(parents=True, exist_ok=True)
    unseen = gym.make_vec(ENV, num_envs=len(HELD_OUT), traffic_seeds=HELD_OUT, **KEYWORDS)

    def error(policy=None):
        if policy is None:
            save_policy(
                FILE, model.policy, envs.config, normalisation=scaled, env=ENV, keywords=KEYWORDS,
                training={"learner": "sb3_ppo", "seed": seed, "steps": steps}, figures={},
            )  # fmt: skip
            policy = load_policy(FILE, unseen)
        rows = dptse_env.evaluate(unseen, policy, HELD_OUT)
        return -1000 * np.mean([row["reward"] for row in rows])

    untrained = error()
    model.learn(steps, ReplicaBaseline(8))
    rule = error("speed-front")
    print(f"error x 1000: untrained {untrained:.1f}, trained {error():.1f}, rule {rule:.1f}")


if __name__ == "__main__":
    tyro.cli(main)
