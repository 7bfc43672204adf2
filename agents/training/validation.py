"""`Validation`: errors of policies on validation traffic, all episodes at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from agents.environments import make_vector
from agents.seeds import TRAINING_VALIDATION, require_seeds
from dptse_env.config import VALIDATION_SEEDS
from dptse_env.evaluation import Policy, evaluate
from dptse_env.utils.arrays import FloatArray


class Validation:
    """Runs policies over validation traffic, each over the same traffic and noise."""

    def __init__(self, env: str, keywords: Mapping[str, Any], seeds: Sequence[int]) -> None:
        """Make the environment, one episode for each traffic seed.

        Raises:
            ValueError: A seed is not in `VALIDATION_SEEDS`, or a keyword is out of range.
        """
        require_seeds("validation", seeds, VALIDATION_SEEDS)
        self.seeds = list(seeds)
        keywords = {**keywords, "traffic_seeds": self.seeds}
        self.env = make_vector(env, len(self.seeds), keywords)

    def errors(self, policy: Policy, *, deterministic: bool) -> FloatArray:
        """Return the mean error of each episode after the warm-up, shape (n seeds,).

        The error is minus the environment's reward: for the joint reward the normalised RMSE of
        density and speed together. Draws of torch are seeded, and its generator is left as found.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(TRAINING_VALIDATION.start)
            rows = evaluate(
                self.env,
                policy,
                self.seeds,
                TRAINING_VALIDATION.start,
                deterministic=deterministic,
            )
        return np.array([-row["reward"] for row in rows])
