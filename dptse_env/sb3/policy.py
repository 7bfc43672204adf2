"""`PlackettLucePolicy`: which B segments to query, for PPO of stable-baselines3."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import Tensor

from dptse_env.config import resolve
from dptse_env.sb3.channels import RoadChannels
from dptse_env.sb3.plackett_luce import PlackettLuce
from dptse_env.sb3.torch_modules import Critic, RatedAdam, Road, Scorer

RULE = {"density_log_std": 2.8, "speed_log_std": 1.2, "age": 7.2}
"""First weights of the scores; untrained, the policy asks what is uncertain or long not seen."""


class PlackettLucePolicy(ActorCriticPolicy):
    """Scores every segment by one network and asks an ordered set of B distinct ones.

    Actions are those of the encoding ``slots``. Random ones follow the Plackett-Luce distribution
    over the scores, deterministic ones are the B highest scores, ties upstream. The network
    (`dptse_env.sb3.torch_modules.Scorer`) starts as a rule and learns a correction to it. The value
    has a network of its own: with a shared one, the value's loss spoils the scores.

    One set of weights serves any B, any estimator, any privacy and any encoding of the same
    observation blocks, and roads of any length with the same kinds of ramps and sensors: nothing
    in it is tied to a segment. What it has learned may suit another road less.

    Where observations are longer than ``road.size``, the rest is for the critic alone: values per
    segment that a training may know and an acting policy does not, such as the true errors (an
    asymmetric critic; Pinto et al., 2018). The scores never see it.

    The entropy that PPO may reward is the sum of the entropies of the B draws along the order
    drawn, an unbiased estimate of the exact one.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *,
        road: RoadChannels | str,
        width: int = 48,
        critic_width: int = 24,
        critic_rate: float = 30.0,
        rule: Mapping[str, float] = RULE,
        **keywords: Any,
    ) -> None:
        """Make the networks.

        Args:
            observation_space: Flat observations of ``road.size`` numbers, and maybe a multiple of
                n more for the critic.
            action_space: ``MultiDiscrete([n] * B)``, of the encoding ``slots``.
            lr_schedule: Learning rate by the share of training left.
            road: How observations are laid out, `RoadChannels.of` the environment's configuration,
                or the name of a preset, for recipes that are text.
            width: Features per segment of the scorer.
            critic_width: Features per segment of the critic.
            critic_rate: Learning rate of the critic over that of the scorer, which must move slowly
                where its scores are steep.
            rule: First weights of observation blocks in the scores.
            **keywords: As `PPO` passes them on; ``use_sde`` must be False.

        Raises:
            ValueError: A space does not fit ``road``.
        """
        if isinstance(road, str):
            road = RoadChannels.of(resolve(road, {}))
        _check_spaces(observation_space, action_space, road)
        assert isinstance(action_space, spaces.MultiDiscrete)
        self.bandwidth = len(action_space.nvec)
        self.road, self.width, self.critic_width = road, width, critic_width
        self.critic_rate = critic_rate
        self.rule = dict(rule)
        super().__init__(observation_space, action_space, lr_schedule, net_arch=[], **keywords)

    def _build(self, lr_schedule: Schedule) -> None:
        self.channels = Road(self.road)
        self.scorer = Scorer(self.road, self.width, self.rule)
        assert self.observation_space.shape is not None
        self.n_extra = (self.observation_space.shape[0] - self.road.size) // self.road.n_mainline
        self.critic = Critic(self.road.n_channels + self.n_extra, self.critic_width)
        groups = [
            {"params": list(self.scorer.parameters()), "factor": 1.0},
            {"params": list(self.critic.parameters()), "factor": self.critic_rate},
        ]
        self.optimizer = RatedAdam(groups, lr=lr_schedule(1), eps=1e-5)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        own = ("observation_space", "action_space", "lr_schedule")
        kept = {key: parameters[key] for key in own}
        critic = {"critic_width": self.critic_width, "critic_rate": self.critic_rate}
        return {**kept, "road": self.road, "width": self.width, **critic, "rule": self.rule}

    def without_extra(self, observation_space: spaces.Space[Any]) -> PlackettLucePolicy:
        """Return a copy that acts alike by plain observations, its critic untrained."""
        policy = PlackettLucePolicy(
            observation_space,
            self.action_space,
            self._dummy_schedule,
            road=self.road,
            width=self.width,
            rule=self.rule,
        )
        policy.scorer.load_state_dict(self.scorer.state_dict())
        return policy

    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions (k, B), values (k, 1) and log-probabilities (k,) of observations."""
        channels = self.channels(obs)
        sets = self._sets(channels)
        actions = sets.mode() if deterministic else sets.sample()
        return actions, self._value(obs, channels), sets.log_prob(actions)

    def evaluate_actions(self, obs: PyTorchObs, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values (k, 1), log-probabilities and entropies (k,) of actions taken."""
        assert isinstance(obs, Tensor)
        channels = self.channels(obs)
        log_prob, entropy = self._sets(channels).evaluate(actions.long())
        return self._value(obs, channels), log_prob, entropy

    def predict_values(self, obs: PyTorchObs) -> Tensor:
        """Return the values of observations, shape (k, 1)."""
        assert isinstance(obs, Tensor)
        return self._value(obs, self.channels(obs))

    def get_distribution(self, obs: PyTorchObs) -> PlackettLuce:  # type: ignore[override]
        """Return the distribution over ordered sets.

        It is none of stable-baselines3's: those are made by a layer that knows the road's length.
        """
        assert isinstance(obs, Tensor)
        return self._sets(self.channels(obs))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        sets = self.get_distribution(observation)
        return sets.mode() if deterministic else sets.sample()

    def _value(self, observation: Tensor, channels: Tensor) -> Tensor:
        """Return the values (k, 1) by the channels and what is for the critic alone."""
        rest = observation[:, self.road.size :]
        extra = rest.reshape(len(rest), self.n_extra, self.road.n_mainline)
        values: Tensor = self.critic(torch.cat([channels, extra], dim=1))
        return values

    def _sets(self, channels: Tensor) -> PlackettLuce:
        return PlackettLuce(self.scorer(channels), self.bandwidth)


def _check_spaces(
    observations: spaces.Space[Any], actions: spaces.Space[Any], road: RoadChannels
) -> None:
    """Refuse spaces that do not fit the layout."""
    size = observations.shape[0] if observations.shape and len(observations.shape) == 1 else 0
    if size < road.size or (size - road.size) % road.n_mainline:
        raise ValueError(
            f"observation_space must have shape {(road.size,)} as road has, or a multiple of "
            f"{road.n_mainline} more, got {observations}"
        )
    if (
        not isinstance(actions, spaces.MultiDiscrete)
        or actions.nvec.ndim != 1
        or (actions.nvec != road.n_mainline).any()
        or len(actions.nvec) > road.n_mainline
    ):
        raise ValueError(
            f"action_space must be MultiDiscrete([{road.n_mainline}] * B) with B up to "
            f"{road.n_mainline}, of action='slots'; got {actions}"
        )
