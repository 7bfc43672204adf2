"""Trained policies as small files, which are checked against the environment when loaded."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import nn

from dptse_env.config import EnvConfig
from dptse_env.estimators import ESTIMATORS
from dptse_env.parts import QueryInterface, make_interface
from dptse_env.policies import SUFFIX, TRANSFERABLE, read_policy
from dptse_env.sb3.road_policy import RoadChannels, RoadPolicy, config_of
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import Action, BoolArray, Observation
from dptse_env.utils.fields import integer
from dptse_env.utils.files import write_tensors
from dptse_env.utils.registry import needed_for, require_registered

POLICY_FORMAT = "dptse-policy-1"
"""Format of the weights; its number is raised when saved weights change their meaning."""

MOST_LAYERS = 64
"""Largest number of layers of a perceptron."""

SHARED, MASKED = "RoadPolicy", "MaskableActorCriticPolicy"
CRITIC = "critic."
"""Beginning of the names of a `RoadPolicy`'s weights that actions do not depend on."""

ACTOR_SIZES = ("width", "reach", "skips_sensors")
"""Arguments of a `RoadPolicy` that its actor depends on."""

CLASSES = (SHARED, "ActorCriticPolicy", MASKED)
"""Classes of policies that can be saved. The network of the first is shared by all segments."""

_PLAIN = "single segments"


class ActingPolicy:
    """A policy of stable-baselines3 that acts by observations alone.

    Attributes:
        interface: Interface of its environment.
        card: Description of the policy, its training, and the environments it fits; empty where it
            was not loaded.
    """

    def __init__(
        self, policy: BasePolicy, interface: QueryInterface, card: Mapping[str, Any] | None = None
    ) -> None:
        """Bind a policy to an environment's interface."""
        self._policy, self.interface, self.card = policy, interface, dict(card or {})
        # A maskable policy expects masks as an argument; they are part of the observation.
        self._takes_masks = type(policy).__name__ == MASKED

    def predict(
        self,
        observation: Observation,
        state: tuple[Any, ...] | None = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Action, tuple[Any, ...] | None]:
        """Return actions for one observation (size,) or a batch (k, size).

        Args:
            observation: From the environment.
            state: Not needed; returned as it is.
            episode_start: Not needed.
            deterministic: The most probable action instead of a random one. Random ones are drawn
                by torch's generator.
        """
        extra: dict[str, Any] = {}
        if self._takes_masks:
            extra["action_masks"] = self._masks(np.asarray(observation))
        action, _ = self._policy.predict(observation, deterministic=deterministic, **extra)
        return action, state

    def _masks(self, observation: Observation) -> BoolArray:
        """Return the options that may be picked next, (G,) or (k, G)."""
        actions = self.interface.actions
        picked = np.zeros((*observation.shape[:-1], actions.n_options), dtype=bool)
        if actions.actions_per_step > 1:
            picked = self.interface.observations.block(observation, "picked") > 0
        return actions.available(np.atleast_2d(picked)).reshape(picked.shape)


def save_policy(
    path: str | os.PathLike[str],
    policy: BasePolicy,
    config: EnvConfig,
    *,
    env: str,
    keywords: Mapping[str, Any],
    training: Mapping[str, Any],
    figures: Mapping[str, Any],
) -> None:
    """Write a policy's weights and its card to a file.

    An existing file is replaced when the new one is complete.

    Args:
        path: A file that ends in ``.safetensors``.
        policy: One of `RoadPolicy`, ``ActorCriticPolicy``, ``MaskableActorCriticPolicy``.
        config: Configuration of the environment that it was trained on.
        env: Id of that environment.
        keywords: Keywords of that environment, plain JSON.
        training: Recipe, seeds, steps; plain JSON.
        figures: Results, by name; plain JSON.

    Raises:
        ValueError: The policy could not be loaded again: it is of another class, has additional
            parts, is too large, or has weights that are not finite. Or the path does not end
            in ``.safetensors``.
        OSError: The file cannot be written.
    """
    name = type(policy).__name__
    if name not in CLASSES:
        raise ValueError(f"policy must be one of {', '.join(CLASSES)}, got {name}")
    if Path(path).suffix != SUFFIX:
        raise ValueError(f"path must end in {SUFFIX}, got {os.fspath(path)!r}")
    card: dict[str, Any] = {
        "fits": _fit(config, name),
        "policy": {"class": name, "arguments": _arguments(policy)},
        "env": env,
        "keywords": dict(keywords),
        "trained_on": describe_road(config.corridor),
        "estimator": ESTIMATORS.name_of(config.estimator),
        "epsilon": config.privacy.epsilon,
        "versions": {name: version(name) for name in ("dptse-env", "stable-baselines3", "torch")},
        "training": dict(training),
        "figures": dict(figures),
    }
    weights = {
        key: value.detach().cpu().numpy()
        for key, value in policy.state_dict().items()
        if name != SHARED or not key.startswith(CRITIC)
    }
    try:
        require_registered(card["fits"]["action"], "fits.action")
        _made(card, weights, config)
    except ValueError as problem:
        raise ValueError(f"policy cannot be saved: {problem}") from problem
    write_tensors(path, weights, card)


def load_policy(
    source: str | os.PathLike[str], env: Any, *, allow: Collection[str] = ()
) -> ActingPolicy:
    """Load a policy for an environment.

    No code in the file is run. Its size, its values and the size of its network are checked before
    anything is built.

    Args:
        source: A file, or the name of a policy that comes with the package
            (`dptse_env.policies`).
        env: The environment in which it acts: of this package, scalar or vector, wrapped or not,
            or as an `SB3VecEnv`.
        allow: Properties that may differ on purpose, of `TRANSFERABLE`. Estimator, privacy and
            traffic model may always differ. With ``"corridor"`` a `RoadPolicy` acts on
            roads of any size whose observations have the same channels (`RoadChannels`); a
            perceptron's observations must have the same size.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is not a saved policy, or the policy does not fit the environment: the
            message names the values of both.
    """
    unknown = [name for name in allow if name not in TRANSFERABLE]
    if unknown:
        raise ValueError(f"allow must be of {', '.join(TRANSFERABLE)}, got {unknown[0]!r}")
    config = config_of(env)
    file = read_policy(source)
    try:
        _check_fit(file.card, config, allow)
        policy = _made(file.card, file.weights, config)
    except ValueError as problem:
        raise ValueError(f"policy {file.source!r} cannot be loaded: {problem!s:.1000}") from problem
    return ActingPolicy(policy, make_interface(config), file.card)


def describe_road(corridor: Corridor) -> str:
    """Return the name and the sizes of a corridor in words."""
    length = min(corridor.segment_lengths[: corridor.n_mainline])
    return (
        f"{corridor.name} ({corridor.n_mainline} mainline segments of {length:g} km, "
        f"{corridor.most_lanes} lanes, fixed sensors on {list(corridor.fixed_sensors)})"
    )


# The environment that a policy fits.


def _fit(config: EnvConfig, name: str) -> dict[str, Any]:
    """Return what an environment and a policy of class `name` must agree in, as plain JSON."""
    encoding = make_interface(config).observations
    sizes = [f"{block}:{place.stop - place.start}" for block, place in encoding.slices.items()]
    fit: dict[str, Any] = {
        "format": POLICY_FORMAT,
        "observation": " ".join(sizes),
        "action": ACTION_ENCODINGS.name_of(config.action),
        "corridor": config.corridor.digest,
        "bandwidth": config.bandwidth,
    }
    if not config.queries.are_plain:
        fit["queries"] = f"{config.queries}, bandwidth_unit {config.bandwidth_unit!r}"
    if name == SHARED:
        fit["channels"] = [channel.name for channel in RoadChannels.from_config(config).channels]
    return fit


def _check_fit(card: Mapping[str, Any], config: EnvConfig, allow: Collection[str]) -> None:
    """Refuse a policy that does not fit an environment.

    Raises:
        ValueError: A property outside `allow` differs; the message names the values of both.
    """
    there, here = card["fits"], _fit(config, card["policy"]["class"])
    pairs = {key: (there.get(key), here[key]) for key in ("format", "action", "bandwidth")}
    pairs["queries"] = there.get("queries", _PLAIN), here.get("queries", _PLAIN)
    road_there, road_here = there["corridor"], here["corridor"]
    observations = there.get("observation"), here["observation"]
    if "channels" in here:
        # Another number of segments is a matter of the corridor: the network is shared by them.
        named, ours = there.get("channels"), set(here["channels"])
        theirs = set(map(str, named)) if isinstance(named, list) else set()
        pairs["channels"] = sorted(theirs - ours), sorted(ours - theirs)
        is_moved = (road_there, observations[0]) != (road_here, observations[1])
    else:
        pairs["observation"] = observations
        is_moved = road_there != road_here
    if is_moved:
        pairs["corridor"] = (
            f"{card['trained_on']}, traffic {road_there:.8}",
            f"{describe_road(config.corridor)}, traffic {road_here:.8}",
        )
    differences = {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
    refused = {key: pair for key, pair in differences.items() if key not in allow}
    if refused:
        text = "; ".join(
            f"{key} is {there!r:.300} for the policy and {here!r:.300} for the environment"
            for key, (there, here) in refused.items()
        )
        if all(key in TRANSFERABLE for key in refused):
            text += f"; to transfer it on purpose, allow {' and '.join(sorted(refused))}"
        raise ValueError(text)


# The network of a policy, described by the arguments on its card.


def _arguments(policy: BasePolicy) -> dict[str, Any]:
    """Return the arguments from which `_made` makes such a policy, as plain JSON."""
    if isinstance(policy, RoadPolicy):
        return {name: policy.sizes[name] for name in ACTOR_SIZES}
    # Maskable policies have the same attributes, without being of the same class.
    perceptron: Any = policy
    if perceptron.activation_fn is not nn.Tanh:
        units = perceptron.activation_fn.__name__
        raise ValueError(f"policy must have Tanh units, got {units}")
    return {"net_arch": perceptron.net_arch}


def _made(
    card: Mapping[str, Any], weights: Mapping[str, np.ndarray[Any, Any]], config: EnvConfig
) -> BasePolicy:
    """Make the policy of a card for an environment of ``config``.

    Raises:
        ValueError: An argument is unknown or out of range, or the weights are others.
    """
    name, arguments = card["policy"]["class"], card["policy"]["arguments"]
    if name not in CLASSES:
        raise ValueError(f"policy.class must be one of {', '.join(CLASSES)}, got {name!r:.80}")
    if any(array.dtype != np.float32 for array in weights.values()):
        raise ValueError("weights must be of float32 alone")
    n_values = sum(array.size for array in weights.values())
    # The random initial weights are replaced; torch's generator is left unchanged.
    with torch.random.fork_rng(devices=[]):
        if name == SHARED:
            _check_shared(arguments, n_values)
            policy: BasePolicy = RoadPolicy.from_config(config, **arguments)
        else:
            policy = _perceptron(name, arguments, config, n_values)
    tensors = {key: torch.tensor(array) for key, array in weights.items()}
    if name == SHARED:
        own = policy.state_dict()
        tensors |= {key: own[key] for key in own if key.startswith(CRITIC)}
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as problem:  # the message has a line for each of them
        raise ValueError(" ".join(str(problem).split())) from problem
    policy.set_training_mode(False)
    return policy


def _check_shared(arguments: Mapping[str, Any], n_values: int) -> None:
    _check_names(arguments, set(ACTOR_SIZES))
    width, reach = (
        integer(f"policy.arguments.{name}", arguments[name], 1) for name in ("width", "reach")
    )
    # Of the trunk's second convolution and of its mean.
    _check_size(2 * (reach + 1) * width * width, n_values)
    if not isinstance(skips := arguments["skips_sensors"], bool):
        raise ValueError(f"policy.arguments.skips_sensors must be a bool, got {skips!r:.80}")


def _perceptron(
    name: str, arguments: Mapping[str, Any], config: EnvConfig, n_values: int
) -> BasePolicy:
    _check_names(arguments, {"net_arch"})
    architecture, interface = arguments["net_arch"], make_interface(config)
    branches = architecture if isinstance(architecture, dict) else {"pi": architecture}
    for branch, widths in branches.items():
        if branch not in ("pi", "vf") or not isinstance(widths, list):
            raise ValueError(
                "policy.arguments.net_arch must be a list of widths, or one each for pi and vf, "
                f"got {architecture!r:.80}"
            )
        integer("policy.arguments.net_arch: layers", len(widths), 0, MOST_LAYERS)
        units = [integer(f"policy.arguments.net_arch[{k}]", w, 1) for k, w in enumerate(widths)]
        inputs = spaces.flatdim(interface.observations.space)
        _check_size(sum(a * b for a, b in pairwise([inputs, *units])), n_values)
    kind: Any = ActorCriticPolicy
    if name == MASKED:
        if config.action != "sequential":
            raise ValueError(f"{name} acts by action encoding 'sequential', got {config.action!r}")
        with needed_for("a policy with masks"):  # no other one needs sb3-contrib
            from sb3_contrib.common.maskable import policies  # noqa: PLC0415

        kind = policies.MaskableActorCriticPolicy
    # The weights are replaced, so the slow orthogonal initialisation is not needed.
    policy: BasePolicy = kind(
        interface.observations.space, interface.actions.space, lambda _: 0.0, ortho_init=False,
        **arguments,
    )  # fmt: skip
    return policy


def _check_names(arguments: Mapping[str, Any], expected: set[str]) -> None:
    if set(arguments) != expected:
        raise ValueError(
            f"policy.arguments must be {', '.join(sorted(expected))}, got "
            f"{', '.join(map(repr, arguments))!s:.80}"
        )


def _check_size(wanted: int, n_values: int) -> None:
    """Refuse a network of more weights than a file has, before it takes memory."""
    if wanted > n_values:
        raise ValueError(f"policy.arguments describe {wanted:.3g} weights, it has {n_values}")
