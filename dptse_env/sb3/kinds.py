"""Kinds of policies that can be saved, each with its description on a card."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, TypeAlias

from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import nn

from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface
from dptse_env.sb3.channels import RoadChannels
from dptse_env.sb3.policy import PlackettLucePolicy
from dptse_env.sb3.torch_modules import KERNEL_SIZE
from dptse_env.utils.extras import needed_for
from dptse_env.utils.fields import integer

Shapes: TypeAlias = dict[str, tuple[int, ...]]

LARGEST_LAYER = 100_000
"""Largest number of units of a layer."""

LARGEST_WEIGHT = 1e6
"""Largest magnitude of an initial weight of a rule."""


class Kind(ABC):
    """Saving and loading of a class of policies.

    Attributes:
        is_shared: Whether the network is shared by all segments, so that the policy can act on a
            road of another size.
    """

    is_shared: bool

    @abstractmethod
    def describe(self, policy: BasePolicy) -> dict[str, Any]:
        """Return the arguments from which `make` makes such a policy, as plain JSON.

        Raises:
            ValueError: The policy has a part that arguments cannot describe.
        """

    @abstractmethod
    def shapes(self, config: EnvConfig, arguments: Mapping[str, Any]) -> Shapes:
        """Return the shapes of a policy's weights by name, without making it.

        Raises:
            ValueError: An argument is unknown, missing, or out of range.
        """

    @abstractmethod
    def make(self, config: EnvConfig, arguments: Mapping[str, Any]) -> BasePolicy:
        """Make a policy with random weights; ``arguments`` have passed `shapes`."""


class _PlackettLuce(Kind):
    is_shared = True

    def describe(self, policy: BasePolicy) -> dict[str, Any]:
        assert isinstance(policy, PlackettLucePolicy)
        return {
            "width": policy.width, "rule": policy.rule, "skips_sensors": policy.skips_sensors,
        }  # fmt: skip

    def shapes(self, config: EnvConfig, arguments: Mapping[str, Any]) -> Shapes:
        _check_names({"skips_sensors": False, **arguments}, {"width", "rule", "skips_sensors"})
        _check_action(config, "slots")
        skips = arguments.get("skips_sensors", False)
        if not isinstance(skips, bool):
            raise ValueError(f"policy.arguments.skips_sensors must be a bool, got {skips!r:.80}")
        width, rule = _size("width", arguments["width"]), arguments["rule"]
        if not isinstance(rule, dict) or not rule:
            raise ValueError(f"policy.arguments.rule must be a mapping of blocks, got {rule!r:.80}")
        road = RoadChannels.from_config(config)
        for name, weight in rule.items():
            road.index(name)
            if not isinstance(weight, int | float) or not abs(weight) <= LARGEST_WEIGHT:
                raise ValueError(
                    f"policy.arguments.rule.{name} must be a number up to {LARGEST_WEIGHT:g}, got "
                    f"{weight!r:.80}"
                )
        convolution = (width, width, KERNEL_SIZE)
        return {
            "scorer.rule": (len(rule),),
            "scorer.trunk.near.weight": (width, road.n_channels, KERNEL_SIZE),
            "scorer.trunk.near.bias": (width,),
            "scorer.trunk.far.weight": convolution,
            "scorer.trunk.far.bias": (width,),
            "scorer.trunk.whole.weight": (width, width),
            "scorer.correction.weight": (1, width, 1),
        }

    def make(self, config: EnvConfig, arguments: Mapping[str, Any]) -> BasePolicy:
        road = RoadChannels.from_config(config)
        # Policies of version 0.1 query every segment.
        known = {"skips_sensors": False, **arguments}
        return PlackettLucePolicy(*_spaces(config), road=road, **known)


class _Perceptron(Kind):
    is_shared = False

    def describe(self, policy: BasePolicy) -> dict[str, Any]:
        # Maskable policies have the same attributes, without being of the same class.
        units: Any = policy.activation_fn
        if units is not nn.Tanh:
            raise ValueError(f"policy must have Tanh units, got {units.__name__}")
        return {"net_arch": policy.net_arch}

    def shapes(self, config: EnvConfig, arguments: Mapping[str, Any]) -> Shapes:
        _check_names(arguments, {"net_arch"})
        architecture = arguments["net_arch"]
        if not isinstance(architecture, dict):
            architecture = {"pi": architecture, "vf": architecture}
        if not set(architecture) <= {"pi", "vf"}:
            raise ValueError(
                f"policy.arguments.net_arch must have pi and vf, got {list(architecture)!r:.80}"
            )
        observations, actions = _spaces(config)
        outputs = {"pi": ("policy", "action", spaces.flatdim(actions)), "vf": ("value", "value", 1)}
        shapes: Shapes = {}
        for branch, (network, head, size) in outputs.items():
            hidden = architecture.get(branch, [])
            if not isinstance(hidden, list):
                raise ValueError(f"policy.arguments.net_arch must have lists, got {hidden!r:.80}")
            widths = [
                spaces.flatdim(observations),
                *(_size(f"net_arch[{k}]", width) for k, width in enumerate(hidden)),
            ]
            for k, (inputs, units) in enumerate(pairwise(widths)):
                layer = f"mlp_extractor.{network}_net.{2 * k}"
                shapes |= {f"{layer}.weight": (units, inputs), f"{layer}.bias": (units,)}
            shapes |= {f"{head}_net.weight": (size, widths[-1]), f"{head}_net.bias": (size,)}
        if isinstance(actions, spaces.Box):
            shapes["log_std"] = (spaces.flatdim(actions),)
        return shapes

    def make(self, config: EnvConfig, arguments: Mapping[str, Any]) -> BasePolicy:
        # The weights are replaced, so the slow orthogonal initialisation is not needed.
        return ActorCriticPolicy(*_spaces(config), _no_rate, ortho_init=False, **arguments)


class _MaskablePerceptron(_Perceptron):
    def shapes(self, config: EnvConfig, arguments: Mapping[str, Any]) -> Shapes:
        _check_action(config, "sequential")
        return super().shapes(config, arguments)

    def make(self, config: EnvConfig, arguments: Mapping[str, Any]) -> BasePolicy:
        with needed_for("a policy with masks"):  # no other one needs sb3-contrib
            from sb3_contrib.common.maskable.policies import (  # noqa: PLC0415
                MaskableActorCriticPolicy,
            )

        policy: BasePolicy = MaskableActorCriticPolicy(
            *_spaces(config), _no_rate, ortho_init=False, **arguments
        )
        return policy


KINDS: Mapping[str, Kind] = {
    "PlackettLucePolicy": _PlackettLuce(),
    "ActorCriticPolicy": _Perceptron(),
    "MaskableActorCriticPolicy": _MaskablePerceptron(),
}
"""Kinds by the name of the policy's class."""


def _spaces(config: EnvConfig) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    interface = make_interface(config)
    return interface.observations.space, interface.actions.space


def _no_rate(_: float) -> float:
    """Return the learning rate of a policy that does not learn."""
    return 0.0


def _check_names(arguments: Mapping[str, Any], expected: set[str]) -> None:
    if set(arguments) != expected:
        raise ValueError(
            f"policy.arguments must be {', '.join(sorted(expected))}, got "
            f"{', '.join(map(repr, arguments))!s:.80}"
        )


def _check_action(config: EnvConfig, action: str) -> None:
    if config.action != action:
        raise ValueError(f"its class acts by action encoding {action!r}, got {config.action!r}")


def _size(name: str, value: object) -> int:
    return integer(f"policy.arguments.{name}", value, 1, LARGEST_LAYER)
