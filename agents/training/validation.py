"""`Validation`: what a policy reaches on validation traffic, all episodes at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from agents.evaluation import WARM_UP, Policy
from dptse_env.arrays import FloatArray
from dptse_env.config import VALIDATION_SEEDS
from dptse_env.vector_env import SensorQueryVectorEnv

NOISE_SEED = 5_000_000
"""Noise and estimators of validation are seeded with this plus the traffic seed."""


class Validation:
    """Runs policies over validation traffic, each over the same traffic and noise."""

    def __init__(self, env: str, keywords: Mapping[str, Any], seeds: Sequence[int]) -> None:
        """Make the environment, one episode for each traffic seed.

        Raises:
            ValueError: A seed is not in `VALIDATION_SEEDS`, or a keyword is out of range.
        """
        strangers = [seed for seed in seeds if seed not in VALIDATION_SEEDS]
        if strangers or not seeds:
            raise ValueError(
                f"validation must be traffic seeds in {VALIDATION_SEEDS[0]}.."
                f"{VALIDATION_SEEDS[-1]}, got {strangers[:1] or 'none'}"
            )
        self.seeds = list(seeds)
        made = gym.make_vec(
            env,
            num_envs=len(self.seeds),
            **{**keywords, "autoreset_mode": "Disabled", "traffic_seeds": self.seeds},
        )
        assert isinstance(made, SensorQueryVectorEnv)
        self.env = made

    def errors(self, policy: Policy, *, deterministic: bool) -> FloatArray:
        """Return the mean error of each episode after the warm-up, shape (n seeds,).

        The error is minus the environment's reward: for the joint reward the normalised RMSE of
        density and speed together. Draws of torch are seeded, and its generator is left as found.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(NOISE_SEED)
            return self._run(policy, deterministic)

    def _run(self, policy: Policy, deterministic: bool) -> FloatArray:
        noise = [NOISE_SEED + seed for seed in self.seeds]
        observation, _ = self.env.reset(seed=noise, options={"traffic_seed": self.seeds})
        process, n = self.env.process, len(self.seeds)
        state: Any = None
        start = np.ones(n, dtype=bool)
        total, n_seconds = np.zeros(n), 0
        while not process.over.any():
            actions, state = policy.predict(observation, state, start, deterministic)
            start = np.zeros(n, dtype=bool)
            before = process.time.copy()
            transition = self.env.advance(actions)
            observation = transition.observation
            # A sequential action may leave the traffic where it is.
            if (process.time > before).all() and process.time[0] > WARM_UP:
                total -= transition.reward
                n_seconds += 1
        if not n_seconds:
            raise ValueError(f"an episode must be longer than the warm-up of {WARM_UP} s")
        errors: FloatArray = total / n_seconds
        return errors
