"""PPO of stable-baselines3 that queries better than the best rule.

python examples/sb3_ppo.py

One of six segments is queried a second. A hundred episodes step at once in one process; after a few
minutes on one core the policy is some 8 % below the best rule, on traffic that it never met.
`VecNormalize` scales observations and rewards by running statistics. Use it: without it PPO ends
near the rule. A policy needs the same statistics where it acts, hence `Normalised`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from dptse_env import evaluate
from dptse_env.sb3 import SB3VecEnv


@dataclass(frozen=True)
class Args:
    """Train with PPO."""

    env: str = "dptse_env:dptse/ShortHighway-v0"
    """Environment id."""
    bandwidth: int = 1
    """Segments that are queried in a second."""
    envs: int = 128
    """Episodes at once."""
    steps: int = 3_000_000
    """Steps to train for, at least; eight minutes for nine million."""
    seed: int = 0
    """Seeds the environments, the actions and the weights."""
    rule: str = "speed-front"
    """Rule to compare with."""
    output: Path = Path("results/sb3")
    """Folder for model.zip and normalisation.pkl."""


class Normalised:
    """A model that is asked about observations as it saw them in its training."""

    def __init__(self, model: PPO, statistics: VecNormalize) -> None:
        """Bind a model to the statistics of its observations."""
        self.model, self.statistics = model, statistics

    def predict(self, observation: Any, *more: Any, **keywords: Any) -> Any:
        """Return actions and the next state; the arguments are those of the model."""
        return self.model.predict(self.statistics.normalize_obs(observation), *more, **keywords)


def main(args: Args) -> None:
    """Train, and compare the policy with rules on held-out traffic."""
    torch.set_num_threads(1)
    keywords: dict[str, Any] = {"action": "slots", "bandwidth": args.bandwidth, "threads": 1}
    # Short episodes that begin anywhere in the records: an update sees all of their hours.
    short = {"traffic_seeds": "0:64", "horizon": 120, "random_start": True}
    training = gym.make_vec(
        args.env, num_envs=args.envs, autoreset_mode="SameStep", **keywords, **short
    )
    statistics = VecNormalize(SB3VecEnv(training), gamma=0.9)
    model = PPO(
        "MlpPolicy", statistics, n_steps=64, batch_size=1024, n_epochs=4, learning_rate=5e-4,
        gamma=0.9, gae_lambda=0.9, ent_coef=0.005, policy_kwargs={"net_arch": [64, 64]},
        seed=args.seed, device="cpu",
    )  # fmt: skip
    seeds = range(1000, 1016)
    held_out = gym.make_vec(
        args.env, num_envs=16, autoreset_mode="Disabled", traffic_seeds="1000:1016", **keywords
    )

    def error(policy: Any) -> float:
        rows = evaluate(held_out, policy, seeds)
        return -1000.0 * float(np.mean([row["reward"] for row in rows]))

    policy = Normalised(model, statistics)
    untrained = error(policy)
    model.learn(args.steps)
    args.output.mkdir(parents=True, exist_ok=True)
    model.save(args.output / "model.zip")
    statistics.save(str(args.output / "normalisation.pkl"))
    trained, round_robin, rule = error(policy), error("round-robin"), error(args.rule)
    print(
        f"mean error: untrained {untrained:.1f}, trained {trained:.1f}, "
        f"round robin {round_robin:.1f}, {args.rule} {rule:.1f}"
    )
    print(f"the model is in {args.output}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
