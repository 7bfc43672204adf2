"""PPO of Ray RLlib (new API stack) on a batch of episodes that steps as one.

pip install -e '.[train]' 'ray[rllib]==2.60.0'
python examples/rllib_ppo.py --steps 300000

RLlib makes its environments with ``gym.make_vec``, and ``gym_env_vectorize_mode`` says how. Its
default, ``sync``, steps scalar environments in turn; ``vector_entry_point`` asks for
`dptse_env.vector_env.SensorQueryVectorEnv`, which steps them at once. RLlib expects the autoreset
of the next step, our default. It cannot act in `MultiBinary`, the space of the default encoding;
``slots`` suits it best, one categorical choice for each query.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
import tyro
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

import dptse_env

ENV = "dptse_env:dptse/ShortHighway-v0"
KEYWORDS = {"estimator": "ekf", "parameters": "published", "action": "slots"}
N_ENVS, BATCH = 64, 4096
HELD_OUT = range(1000, 1008)


class Policy:
    """A module of RLlib as a policy: what `dptse_env.evaluate` asks for."""

    def __init__(self, module: Any) -> None:
        """Take the module of an algorithm, ``algorithm.get_module()``."""
        self.module = module

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        """Return actions and no state."""
        outputs = self.module.forward_inference({Columns.OBS: torch.as_tensor(observation)})
        # Heads of several choices come as a tuple, others as one array.
        logits = outputs[Columns.ACTION_DIST_INPUTS].reshape(len(observation), -1)
        choices = self.module.get_inference_action_dist_cls().from_logits(logits)
        return (choices.to_deterministic() if deterministic else choices).sample().numpy(), None


def error(policy) -> float:
    """Return the error x 1000 on held-out traffic of a policy, or of a schedule by its name."""
    env = gym.make_vec(ENV, num_envs=len(HELD_OUT), traffic_seeds=list(HELD_OUT), **KEYWORDS)
    return -1000 * np.mean([row["reward"] for row in dptse_env.evaluate(env, policy, HELD_OUT)])


def main(steps: int = 300_000, seed: int = 0) -> None:
    """Train, and compare the policy with its untrained self and a rule on held-out traffic."""
    ray.init(address="local", include_dashboard=False, log_to_driver=False)
    algorithm = (
        PPOConfig()
        .environment(ENV, env_config={**KEYWORDS, "horizon": 120, "random_start": True})
        .env_runners(
            num_env_runners=0,  # processes beside this one
            num_envs_per_env_runner=N_ENVS,
            gym_env_vectorize_mode="vector_entry_point",
        )
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64]))
        .training(train_batch_size_per_learner=BATCH, minibatch_size=256, num_epochs=4)
        .training(lr=3e-4, gamma=0.9, entropy_coeff=0.003)
        .debugging(seed=seed)
        .build_algo()
    )
    untrained, done = error(Policy(algorithm.get_module())), 0
    while done < steps:
        collected = algorithm.train()["env_runners"]
        done = int(collected["num_env_steps_sampled_lifetime"])
        print(f"{done} steps, mean return {collected.get('episode_return_mean', np.nan):.2f}")
    trained, rule = error(Policy(algorithm.get_module())), error("speed-front")
    algorithm.stop()
    ray.shutdown()
    print(f"error x 1000: untrained {untrained:.1f}, trained {trained:.1f}, rule {rule:.1f}")


if __name__ == "__main__":
    tyro.cli(main)
