"""Trained policies as small files, which are checked against the environment when loaded."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from dptse_env.config import EnvConfig
from dptse_env.estimators import ESTIMATORS
from dptse_env.parts import QueryInterface, make_interface
from dptse_env.policies import (
    DETERMINISTIC,
    DRAWN,
    SUFFIX,
    TRANSFERABLE,
    read_policy,
    seed_ranges,
)
from dptse_env.release import RELEASE_MODELS, PrivacySettings
from dptse_env.sb3.acting import ActingPolicy, Normalisation
from dptse_env.sb3.road_policy import MOST_NEIGHBOURS, RoadChannels, RoadPolicy
from dptse_env.sb3.vec_env import config_of
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import AnyArray
from dptse_env.utils.files import require_arrays, write_tensors
from dptse_env.utils.registry import needed_for, require_registered
from dptse_env.utils.validation import integer, require, require_name, shown
from dptse_env.versions import versions_with

POLICY_FORMAT = "dptse-policy-2"
"""Format of the weights; its number is raised when saved weights change their meaning."""

MOST_LAYERS = 64
"""Largest number of layers of a perceptron."""

ACTIVATIONS = ("Tanh", "ReLU", "ELU", "GELU", "LeakyReLU", "SiLU")
"""Units of a perceptron, of `torch.nn`."""

SHARED = RoadPolicy.__name__
"""The class whose network is shared by all segments."""

_PERCEPTRON = ("mlp_extractor.policy_net.", "action_net.", "log_std")
_CRITIC = ("mlp_extractor.value_net.", "value_net.", "critic.", "lstm_critic.")


@dataclass(frozen=True)
class Kind:
    """A class of policies that can be saved.

    Attributes:
        module: The module that defines it.
        actions: Encodings of actions that it can have; none for all.
        sizes: Its arguments beside the layers and the units of a perceptron.
        actor: Beginnings of the names of weights that actions depend on, and that are saved.
        rest: Beginnings of the names of those that only a training needs.
    """

    module: str
    actions: tuple[str, ...] = ()
    sizes: tuple[str, ...] = ()
    actor: tuple[str, ...] = _PERCEPTRON
    rest: tuple[str, ...] = _CRITIC


KINDS: Mapping[str, Kind] = {
    SHARED: Kind(
        RoadPolicy.__module__, ("slots",), ("width", "reach", "skips_sensors"), ("scorer.",)
    ),
    "ActorCriticPolicy": Kind("stable_baselines3.common.policies"),
    "MaskableActorCriticPolicy": Kind("sb3_contrib.common.maskable.policies", ("sequential",)),
    "RecurrentActorCriticPolicy": Kind(
        "sb3_contrib.common.recurrent.policies",
        sizes=("lstm_hidden_size", "n_lstm_layers"),
        actor=(*_PERCEPTRON, "lstm_actor."),
    ),
    "DQNPolicy": Kind(
        "stable_baselines3.dqn.policies", ("sequential",), (), ("q_net.",), ("q_net_target.",)
    ),
    "QRDQNPolicy": Kind(
        "sb3_contrib.qrdqn.policies", ("sequential",), ("n_quantiles",), ("quantile_net.",),
        ("quantile_net_target.",),
    ),
}  # fmt: skip
"""Classes of policies that can be saved, by name."""

_PLAIN = "single segments"


def save_policy(
    path: str | os.PathLike[str],
    policy: BasePolicy,
    config: EnvConfig,
    *,
    env: str,
    keywords: Mapping[str, Any],
    training: Mapping[str, Any],
    figures: Mapping[str, Any],
    normalisation: VecNormalize | None = None,
    deterministic: bool = True,
) -> None:
    """Write the weights that a policy acts by, and its card, to a file.

    An existing file is replaced when the new one is complete. Critics and target networks, which
    only a training needs, are left out.

    Args:
        path: A file that ends in ``.safetensors``.
        policy: Of one of the classes of `KINDS`, with the features of flat observations.
        config: Configuration of the environment that it was trained on.
        env: Id of that environment.
        keywords: Keywords of that environment, plain JSON.
        training: Recipe, seeds, steps; plain JSON. ``traffic seeds`` are those of ``config`` unless
            it names others.
        figures: Results, by name; plain JSON.
        normalisation: The wrapper that scaled its observations in the training. Its statistics
            travel in the file, and are applied wherever the policy acts.
        deterministic: Whether it is to take its likeliest action, or to draw actions.

    Raises:
        ValueError: The policy could not be loaded again: it is of another class, has additional
            parts, is too large, or has weights that are not finite. Or the path does not end
            in ``.safetensors``.
        OSError: The file cannot be written.
    """
    name = type(policy).__name__
    kind = KINDS.get(name)
    if kind is None or type(policy).__module__ != kind.module:
        raise ValueError(
            f"policy must be one of {', '.join(KINDS)}, got {type(policy).__module__}.{name}"
        )
    if Path(path).suffix != SUFFIX:
        raise ValueError(f"path must end in {SUFFIX}, got {os.fspath(path)!r}")
    statistics = Normalisation.of(normalisation)
    try:
        card: dict[str, Any] = {
            "fits": _fit(config, name),
            "policy": {"class": name, "arguments": _arguments(policy, kind)},
            "acts": DETERMINISTIC if deterministic else DRAWN,
            "env": env,
            "keywords": dict(keywords),
            "trained_on": describe_road(config.corridor),
            "estimator": ESTIMATORS.name_of(config.estimator),
            "versions": versions_with("stable-baselines3", "torch"),
            "training": {"traffic seeds": seed_ranges(config.traffic_seeds), **training},
            "figures": dict(figures),
        }
        weights = _actor(policy, kind)
        require_registered(card["fits"]["action"], "fits.action")
        if statistics is not None:
            weights |= statistics.arrays()
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
            or as an `SB3VecEnv`. Its keyword ``action`` is the policy's, ``fits.action`` of its
            card.
        allow: Properties that may differ on purpose, of `TRANSFERABLE`. Estimator and traffic model
            may always differ. With ``"corridor"`` a `RoadPolicy` acts on roads of any size whose
            observations have the same channels (`RoadChannels`); a perceptron's observations must
            have the same size. Another release model is told of unless ``"privacy"`` is allowed; it
            is refused in any case where it shows a policy other observations.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is not a saved policy, or the policy does not fit the environment: the
            message names the values of both.

    Warns:
        UserWarning: It was trained with another release model, epsilon, delta or other setting of
            ``privacy``, and ``allow`` lacks ``"privacy"``.
    """
    unknown = [name for name in allow if name not in TRANSFERABLE]
    if unknown:
        raise ValueError(f"allow must be of {', '.join(TRANSFERABLE)}, got {unknown[0]!r}")
    config = config_of(env)
    file = read_policy(source)
    try:
        _check_fit(file.card, config, allow)
        policy, normalisation = _made(file.card, file.weights, config)
    except ValueError as problem:
        raise ValueError(f"policy {file.source!r} cannot be loaded: {problem}") from problem
    others = _other_privacy(file.card["fits"]["privacy"], config.privacy)
    if others and "privacy" not in allow:
        warnings.warn(
            f"policy {file.source!r} was trained for another release: {_in_words(others)}",
            stacklevel=1,
        )
    return ActingPolicy(policy, make_interface(config), file.card, normalisation)


def describe_road(corridor: Corridor) -> str:
    """Return the name and the sizes of a corridor in words."""
    length = min(corridor.geometry.segment_lengths[: corridor.geometry.n_mainline])
    beside = "" if corridor.loops is None else f", {corridor.loops}"
    return (
        f"{corridor.name} ({corridor.geometry.n_mainline} mainline segments of {length:g} km, "
        f"{corridor.geometry.most_lanes} lanes, fixed sensors on {list(corridor.fixed_sensors)}"
        f"{beside})"
    )


# The environment that a policy fits.

_Pair = tuple[Any, Any]


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
        "fixed_sensors": list(config.corridor.fixed_sensors),
        "privacy": _privacy(config.privacy),
    }
    if config.corridor.loops is not None:
        fit["loops"] = config.corridor.loops.fields()
    if config.query_every > 1:
        fit["query_every"] = config.query_every
    if not config.queries.are_segments:
        fit["queries"] = f"{config.queries}, bandwidth_unit {config.bandwidth_unit!r}"
    if name == SHARED:
        fit["channels"] = [channel.name for channel in RoadChannels.from_config(config).channels]
    return fit


def _privacy(settings: PrivacySettings) -> dict[str, Any]:
    """Return what a release model is set to, as plain JSON, without where its noise comes from."""
    plain = {
        name: value if value is None or isinstance(value, str | int | float) else str(value)
        for name, value in vars(settings).items()
        if name != "noise"
    }
    named = {
        "preset": RELEASE_MODELS.name_of(settings.preset),
        "boundary_inputs": settings.boundary,
    }
    return plain | named


def _other_privacy(there: Mapping[str, Any], settings: PrivacySettings) -> dict[str, _Pair]:
    """Return by path the settings of a release that differ, for a policy and here."""
    here = _privacy(settings)
    # Another model has other settings beside those that all have.
    all_have = [field.name for field in fields(PrivacySettings) if field.name in here]
    names = here if there.get("preset") == here["preset"] else all_have
    pairs = {f"privacy.{name}": (there.get(name), here[name]) for name in names}
    return {path: pair for path, pair in pairs.items() if pair[0] != pair[1]}


def _in_words(pairs: Mapping[str, _Pair]) -> str:
    """Return which values a policy and its environment have."""
    return "; ".join(
        f"{key} is {shown(there)} for the policy and {shown(here)} for the environment"
        for key, (there, here) in pairs.items()
    )


def _check_fit(card: Mapping[str, Any], config: EnvConfig, allow: Collection[str]) -> None:
    """Refuse a policy that does not fit an environment.

    Raises:
        ValueError: A property outside `allow` differs; the message names the values of both.
    """
    there, here = card["fits"], _fit(config, card["policy"]["class"])
    pairs = {key: (there.get(key), here[key]) for key in ("format", "action", "bandwidth")}
    pairs["queries"] = there.get("queries", _PLAIN), here.get("queries", _PLAIN)
    pairs["query_every"] = there.get("query_every", 1), config.query_every
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
    # Policies that ship do not name their fixed sensors, and were trained without loops.
    fixed = here["fixed_sensors"]
    sensors = there.get("fixed_sensors", fixed), there.get("loops")
    if is_moved or sensors != (fixed, here.get("loops")):
        pairs["corridor"] = (
            f"{card['trained_on']}, traffic {road_there:.8}",
            f"{describe_road(config.corridor)}, traffic {road_here:.8}",
        )
    differences = {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
    refused = {key: pair for key, pair in differences.items() if key not in allow}
    if refused:
        text = _in_words(refused)
        if "action" in refused:
            text += f"; make the environment with action={shown(there['action'])}"
        elif all(key in TRANSFERABLE for key in refused):
            text += f"; to transfer it on purpose, allow {' and '.join(sorted(refused))}"
        raise ValueError(text)


# The network of a policy, described by the arguments on its card.


def _arguments(policy: Any, kind: Kind) -> dict[str, Any]:
    """Return the arguments from which `_made` makes such a policy, as plain JSON.

    Raises:
        ValueError: It has parts that arguments do not describe.
    """
    if isinstance(policy, RoadPolicy):
        return {name: policy.sizes[name] for name in kind.sizes}
    if policy.features_extractor_class is not FlattenExtractor:
        name = policy.features_extractor_class.__name__
        raise ValueError(f"policy must have the features of FlattenExtractor, got {name}")
    if getattr(policy, "use_sde", False):
        raise ValueError("policy must have use_sde=False")
    architecture, units = policy.net_arch, policy.activation_fn.__name__
    require_name("policy.activation_fn", units, ACTIVATIONS)
    sizes = {
        "lstm_hidden_size": lambda: policy.lstm_output_dim,
        "n_lstm_layers": lambda: policy.lstm_hidden_state_shape[0],
        "n_quantiles": lambda: policy.n_quantiles,
    }
    return {
        "layers": architecture["pi"] if isinstance(architecture, dict) else architecture,
        "units": units,
        **{name: sizes[name]() for name in kind.sizes},
    }


def _actor(policy: BasePolicy, kind: Kind) -> dict[str, AnyArray]:
    """Return the weights that actions depend on.

    Raises:
        ValueError: There are weights of parts that are unknown.
    """
    weights = policy.state_dict()
    unknown = [key for key in weights if not key.startswith((*kind.actor, *kind.rest))]
    if unknown:
        raise ValueError(f"policy has weights of unknown parts: {shown(unknown)}")
    return {
        key: value.detach().cpu().numpy()
        for key, value in weights.items()
        if key.startswith(kind.actor)
    }


def _made(
    card: Mapping[str, Any], arrays: Mapping[str, AnyArray], config: EnvConfig
) -> tuple[BasePolicy, Normalisation | None]:
    """Make the policy of a card for an environment of ``config``, with its normalisation.

    Raises:
        ValueError: An argument is unknown or out of range, or the weights are others.
    """
    name, arguments = card["policy"]["class"], card["policy"]["arguments"]
    require_name("policy.class", name, KINDS)
    kind, interface, weights = KINDS[name], make_interface(config), dict(arrays)
    action = ACTION_ENCODINGS.name_of(config.action)
    if kind.actions and action not in kind.actions:
        raise ValueError(f"{name} acts by action encoding {kind.actions[0]!r}, got {action!r}")
    (size,) = interface.observations.space.shape
    normalisation = Normalisation.taken_from(weights, size)
    if normalisation is not None and name == SHARED:
        raise ValueError(f"{name} scales observations itself: train it with norm_obs=False")
    n_values = sum(array.size for array in weights.values())
    # The random initial weights are replaced; torch's generator is left unchanged.
    with torch.random.fork_rng(devices=[]):
        if name == SHARED:
            _check_shared(arguments, kind, n_values)
            policy: BasePolicy = RoadPolicy.from_config(config, **arguments)
        else:
            policy = _perceptron(name, arguments, interface, n_values)
    require_arrays(
        weights,
        {key: value.shape for key, value in _actor(policy, kind).items()},
        np.float32,
    )
    tensors = {key: torch.tensor(array) for key, array in weights.items()}
    policy.load_state_dict(tensors, strict=False)  # a critic keeps its random weights
    policy.set_training_mode(False)
    return policy, normalisation


def _check_shared(arguments: Mapping[str, Any], kind: Kind, n_values: int) -> None:
    _check_names(arguments, kind.sizes)
    width = integer("policy.arguments.width", arguments["width"], 1)
    reach = integer("policy.arguments.reach", arguments["reach"], 1, MOST_NEIGHBOURS)
    # Of the trunk's second convolution and of its mean.
    _check_size(2 * (reach + 1) * width * width, n_values)
    skips = arguments["skips_sensors"]
    require(isinstance(skips, bool), "policy.arguments.skips_sensors", "a bool", skips)


def _perceptron(
    name: str, arguments: Mapping[str, Any], interface: QueryInterface, n_values: int
) -> BasePolicy:
    kind, n_actions = KINDS[name], interface.actions.n_queries
    _check_names(arguments, ("layers", "units", *kind.sizes))
    layers, units = arguments["layers"], arguments["units"]
    require(isinstance(layers, list), "policy.arguments.layers", "a list of widths", layers)
    integer("policy.arguments.layers: their number", len(layers), 0, MOST_LAYERS)
    widths = [integer(f"policy.arguments.layers[{k}]", w, 1) for k, w in enumerate(layers)]
    sizes = {size: integer(f"policy.arguments.{size}", arguments[size], 1) for size in kind.sizes}
    require_name("policy.arguments.units", units, ACTIVATIONS)
    (inputs,), wanted = interface.observations.space.shape, 0
    if hidden := sizes.get("lstm_hidden_size", 0):
        depth = integer("policy.arguments.n_lstm_layers", sizes["n_lstm_layers"], 1, MOST_LAYERS)
        wanted += 4 * hidden * (inputs + hidden + 2 * (depth - 1) * hidden)
        inputs = hidden
    widths = [inputs, *widths]
    wanted += sum(a * b for a, b in pairwise(widths))
    _check_size(wanted + widths[-1] * n_actions * sizes.get("n_quantiles", 0), n_values)
    with needed_for(f"a {name}"):  # most classes are of sb3-contrib
        make: Any = getattr(importlib.import_module(kind.module), name)
    net_arch: Any = layers
    if issubclass(make, ActorCriticPolicy) or "Maskable" in name:
        # The weights are replaced, so the slow orthogonal initialisation is not needed.
        net_arch, sizes["ortho_init"] = {"pi": layers, "vf": []}, False
    if "lstm_hidden_size" in sizes:
        sizes |= {"shared_lstm": True, "enable_critic_lstm": False}
    policy: BasePolicy = make(
        interface.observations.space,
        interface.actions.space,
        BasePolicy._dummy_schedule,
        net_arch=net_arch,
        activation_fn=getattr(nn, units),
        **sizes,
    )
    return policy


def _check_names(arguments: Mapping[str, Any], expected: Sequence[str]) -> None:
    fits = set(arguments) == set(expected)
    require(fits, "policy.arguments", ", ".join(sorted(expected)), [*arguments])


def _check_size(wanted: int, n_values: int) -> None:
    """Refuse a network of more weights than a file has, before it takes memory."""
    described = "the number of weights that policy.arguments describe"
    require(wanted <= n_values, described, f"at most {n_values}", wanted)
