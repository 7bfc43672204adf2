"""What a policy and an environment share: the encodings and the sizes behind them."""

from __future__ import annotations

from dataclasses import dataclass

from dptse_env.actions import ACTION_ENCODINGS, ActionEncoding
from dptse_env.config import EnvConfig
from dptse_env.observations import ObservationEncoding
from dptse_env.rewards import Reward


@dataclass(frozen=True)
class QueryInterface:
    """The face that an environment shows to a policy.

    Attributes:
        n_mainline: Segments that can be queried.
        bandwidth: Most queries a step.
        actions: The action encoding, with its space.
        observations: The observation encoding, with its space and block names.
        reward: The reward.
    """

    n_mainline: int
    bandwidth: int
    actions: ActionEncoding
    observations: ObservationEncoding
    reward: Reward

    @classmethod
    def of(cls, config: EnvConfig) -> QueryInterface:
        """Build the interface that ``config`` describes."""
        corridor = config.corridor
        scales = {
            "density_scale": corridor.density_scale,
            "speed_scale": corridor.speed_scale,
        }
        return cls(
            n_mainline=corridor.n_mainline,
            bandwidth=config.bandwidth,
            actions=ACTION_ENCODINGS[config.action](corridor.n_mainline, config.bandwidth),
            observations=ObservationEncoding(
                corridor.n_mainline,
                corridor.n_segments,
                corridor.fixed_sensors,
                bandwidth=config.bandwidth,
                epsilon=config.privacy.epsilon,
                with_picked=config.action == "sequential",
                releases_flow=config.privacy.speed == "flow",
                **scales,
            ),
            reward=Reward(config.reward, corridor.n_mainline, **scales),
        )
