"""A ladder: schedules and policies in one environment, each with every estimator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.environments import make_vector
from agents.evaluation.episodes import EpisodeScore, Policy, run_episodes
from agents.policies import NamedSchedule, PolicySource
from dptse_env.policies import TRANSFERABLE
from dptse_env.vector_env import SensorQueryVectorEnv


@dataclass(frozen=True)
class Rung:
    """A policy with an estimator on some traffic, with everything that a worker needs to run it.

    Attributes:
        key: Estimator and name of the policy.
        source: The policy.
        env: Environment id.
        keywords: Keywords of ``gym.make`` that make it, with the library of records.
        seeds: Traffic seeds.
        noise_seed: Noise is seeded with this plus the traffic seed.
        deterministic: Whether the policy takes its likeliest action.
        transferred: Whether the policy may act where it was not trained.
    """

    key: tuple[str, str]
    source: PolicySource
    env: str
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    noise_seed: int = 0
    deterministic: bool = True
    transferred: bool = False

    def make(self) -> tuple[SensorQueryVectorEnv, Policy]:
        """Make the environment, an episode for each traffic seed, and the policy in it.

        Raises:
            ValueError: A keyword is out of range, or the policy does not suit.
        """
        env = make_vector(self.env, len(self.seeds), self.keywords)
        return env, self.load(env)

    def load(self, env: Any) -> Policy:
        """Bind the policy to an environment, scalar or vector."""
        allow = TRANSFERABLE if self.transferred else ()
        return self.source.load(env, allow=allow, seed=self.noise_seed)


def run_rung(rung: Rung) -> list[EpisodeScore]:
    """Run a policy on all its traffic seeds at once."""
    env, policy = rung.make()
    if not isinstance(rung.source, NamedSchedule):
        import torch  # noqa: PLC0415 (schedules alone do without)

        torch.manual_seed(rung.noise_seed)
    return run_episodes(
        env,
        policy,
        traffic_seeds=rung.seeds,
        seeds=[rung.noise_seed + seed for seed in rung.seeds],
        deterministic=rung.deterministic,
    )
