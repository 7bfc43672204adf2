"""`PlackettLucePolicy`: a policy that scores segments and queries an ordered set of them."""

from collections.abc import Mapping
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import Tensor

from dptse_env.sb3.channels import RoadChannels
from dptse_env.sb3.plackett_luce import PlackettLuce
from dptse_env.sb3.torch_modules import RoadFeatures, Scorer

RULE = {"density_log_std": 2.8, "speed_log_std": 1.2, "age": 7.2}
"""Initial weights of the scores: an untrained policy queries segments whose estimate is uncertain
or that have not been observed for long."""


LAST_PLACE = 1e4
"""Subtracted from the scores of segments that are queried only when there are no others."""


class PlackettLucePolicy(BasePolicy):
    """Scores every segment with a shared network and queries an ordered set of B distinct ones.

    Actions are those of the encoding ``slots``. Random ones follow the Plackett-Luce distribution
    over the scores, deterministic ones are the B highest scores, ties upstream. The network
    (`dptse_env.sb3.torch_modules.Scorer`) starts as a rule and learns a correction to it.

    One set of weights serves any B, any estimator, any privacy and roads of any length whose
    channels are the same (`RoadChannels`): nothing in it is tied to a segment. It may perform worse
    on another road.

    The policy has no critic and no optimizer: it is trained by regression and rounds of swaps
    (``scripts/train.py``), not by PPO.

    Attributes:
        bandwidth: B, queries a step.
        road: Layout of the observations.
        width: Features per segment.
        rule: Initial weights of the rule by observation block.
        skips_sensors: Whether it leaves segments with a fixed sensor to that sensor, which tells
            every second what a query would, as long as there are others to query.
        features: Module that arranges observations along the road.
        scorer: Module that scores segments; it has all learned weights.
    """

    handicap: Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        road: RoadChannels,
        width: int = 48,
        rule: Mapping[str, float] = RULE,
        skips_sensors: bool = True,
    ) -> None:
        """Make the network.

        Args:
            observation_space: Flat observations of ``road.size`` numbers.
            action_space: ``MultiDiscrete([n] * B)``, of the encoding ``slots``.
            road: Layout of the observations, `RoadChannels.from_config` of the environment's
                configuration.
            width: Features per segment.
            rule: Initial weights of observation blocks in the scores.
            skips_sensors: Whether segments with a fixed sensor come last.

        Raises:
            ValueError: A space does not fit ``road``, or the rule has an unknown block.
        """
        self.bandwidth = _bandwidth(observation_space, action_space, road)
        super().__init__(observation_space, action_space)
        self.road, self.width, self.rule = road, width, dict(rule)
        self.skips_sensors = skips_sensors
        last = LAST_PLACE * torch.tensor(road.sensor_mark) if skips_sensors else torch.zeros(())
        self.register_buffer("handicap", last, persistent=False)
        self.features = RoadFeatures(road)
        self.scorer = Scorer(road, width, rule)

    def sharing(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        road: RoadChannels,
    ) -> "PlackettLucePolicy":
        """Return a policy for another environment that has the very same weights.

        A training that moves them moves both policies.

        Raises:
            ValueError: A space does not fit ``road``, or its channels differ from those of this
                policy.
        """
        names, own = ([channel.name for channel in each.channels] for each in (road, self.road))
        if names != own:
            missing, more = sorted(set(own) - set(names)), sorted(set(names) - set(own))
            raise ValueError(
                f"environments must have the same channels to share a network; one lacks "
                f"{missing} and has {more} besides"
            )
        twin = PlackettLucePolicy(
            observation_space,
            action_space,
            road=road,
            width=self.width,
            rule=self.rule,
            skips_sensors=self.skips_sensors,
        )
        twin.scorer = self.scorer
        return twin

    def scores(self, observation: Tensor) -> Tensor:
        """Return the scores (k, n) of observations (k, size)."""
        scores: Tensor = self.scorer(self.features(observation))
        return scores

    def get_distribution(self, observation: Tensor) -> PlackettLuce:
        """Return the distribution over ordered sets for observations (k, size)."""
        return PlackettLuce(self.scores(observation) - self.handicap, self.bandwidth)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        assert isinstance(observation, Tensor)
        sets = self.get_distribution(observation)
        return sets.mode() if deterministic else sets.sample()

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "road": self.road,
            "width": self.width,
            "rule": self.rule,
            "skips_sensors": self.skips_sensors,
        }


def _bandwidth(
    observations: spaces.Space[Any], actions: spaces.Space[Any], road: RoadChannels
) -> int:
    """Return B of an action space, or refuse spaces that do not fit the layout."""
    if observations.shape != (road.size,):
        raise ValueError(
            f"observation_space must have shape {(road.size,)}, as in road, got {observations}"
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
    return len(actions.nvec)
