"""Trained policies as small files: written once, and refused where they do not fit."""

from __future__ import annotations

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy

from dptse_env.arrays import Action, Observation
from dptse_env.config import EnvConfig
from dptse_env.interface import QueryInterface
from dptse_env.policies import CARD, TRANSFERABLE, read_policy
from dptse_env.sb3.channels import RoadChannels
from dptse_env.sb3.policy import PlackettLucePolicy

FORMAT = "dptse-policy"
VERSION = 1
"""Raise it whenever saved weights would no longer mean the same."""

TEXT, WEIGHTS = "CARD.md", "weights.pt"

MUST_FIT = ("format", "observation", "action", "corridor", "bandwidth")
"""What a policy must have in common with the environment that it is to act in, but for what of
`dptse_env.policies.TRANSFERABLE` a caller allows: with anything else its weights would not fit."""


class ActingPolicy:
    """A policy of stable-baselines3 that acts by observations alone.

    Attributes:
        interface: Of the environment that it acts in.
    """

    def __init__(self, policy: BasePolicy, interface: QueryInterface) -> None:
        """Bind a policy to an environment's interface."""
        self._policy, self.interface = policy, interface
        # A maskable policy wants masks beside the observation, which holds them, too.
        self._takes_masks = type(policy).__name__ == "MaskableActorCriticPolicy"

    def predict(
        self,
        observation: Observation,
        state: tuple[Any, ...] | None = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Action, tuple[Any, ...] | None]:
        """Return actions for one observation (size,) or a batch (k, size).

        Args:
            observation: What the environment shows.
            state: Not needed; given back as it is.
            episode_start: Not needed.
            deterministic: The most probable action instead of a random one. Random ones are drawn
                by torch's generator.
        """
        extra: dict[str, Any] = {}
        if self._takes_masks:
            picked = self.interface.observations.block(np.asarray(observation), "picked")
            extra["action_masks"] = picked == 0
        action, _ = self._policy.predict(observation, deterministic=deterministic, **extra)
        return action, state


class SavedPolicy(ActingPolicy):
    """A trained policy with the ``predict`` of stable-baselines3.

    Attributes:
        card: What it is, how it was trained, and what it fits.
        interface: Of the environment that it acts in.
    """

    def __init__(
        self, policy: BasePolicy, card: Mapping[str, Any], interface: QueryInterface
    ) -> None:
        """Bind a policy to its card and to an environment's interface."""
        super().__init__(policy, interface)
        self.card = dict(card)


@dataclass(frozen=True)
class _Kind:
    """How a class of policies is made for an environment from the arguments on its card."""

    make: Callable[[EnvConfig, QueryInterface, Mapping[str, Any]], BasePolicy]
    arguments: Callable[[Any], dict[str, Any]]


def _never(_: float) -> float:
    return 0.0


def _make_plackett_luce(
    config: EnvConfig, interface: QueryInterface, arguments: Mapping[str, Any]
) -> BasePolicy:
    space = interface.observations.space, interface.actions.space
    return PlackettLucePolicy(*space, road=RoadChannels.from_config(config), **arguments)


def _make_perceptron(
    _: EnvConfig, interface: QueryInterface, arguments: Mapping[str, Any]
) -> BasePolicy:
    space = interface.observations.space, interface.actions.space
    return ActorCriticPolicy(*space, _never, **arguments)


def _make_maskable(
    _: EnvConfig, interface: QueryInterface, arguments: Mapping[str, Any]
) -> BasePolicy:
    # Only such a policy needs sb3-contrib.
    from sb3_contrib.common.maskable.policies import (  # noqa: PLC0415
        MaskableActorCriticPolicy,
    )

    space = interface.observations.space, interface.actions.space
    policy: BasePolicy = MaskableActorCriticPolicy(*space, _never, **arguments)
    return policy


_KINDS = {
    "PlackettLucePolicy": _Kind(
        _make_plackett_luce, lambda policy: {"width": policy.width, "rule": policy.rule}
    ),
    "ActorCriticPolicy": _Kind(_make_perceptron, lambda policy: {"net_arch": policy.net_arch}),
    "MaskableActorCriticPolicy": _Kind(
        _make_maskable, lambda policy: {"net_arch": policy.net_arch}
    ),
}


def fit_of(config: EnvConfig) -> dict[str, Any]:
    """Return what a policy for ``config`` must fit, as plain JSON; keys as in `MUST_FIT`."""
    encoding = QueryInterface.of(config).observations
    sizes = [f"{name}:{place.stop - place.start}" for name, place in encoding.slices.items()]
    return {
        "format": f"{FORMAT}-{VERSION}",
        "observation": " ".join(sizes),
        "action": config.action,
        "corridor": config.corridor.digest,
        "bandwidth": config.bandwidth,
    }


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
    """Write what acting needs of a policy: its weights and a card.

    The file is put in place when it is whole; one that stood there stays until then.

    Args:
        path: A file that ends in ``.zip``.
        policy: One of `PlackettLucePolicy`, ``ActorCriticPolicy``, ``MaskableActorCriticPolicy``.
        config: What it was trained on.
        env: Environment id.
        keywords: Those of the environment, plain JSON.
        training: Recipe, seeds, steps; plain JSON.
        figures: What it reaches, by name; plain JSON.

    Raises:
        ValueError: Another class of policy, or another ending.
        OSError: The file cannot be written.
    """
    target = Path(path)
    name = type(policy).__name__
    if name not in _KINDS:
        raise ValueError(f"policy must be one of {', '.join(_KINDS)}, got {name}")
    if target.suffix != ".zip":
        raise ValueError(f"path must end in .zip, got {str(path)!r}")
    corridor = config.corridor
    card = {
        "fits": fit_of(config),
        "policy": {"class": name, "arguments": _KINDS[name].arguments(policy)},
        "env": env,
        "keywords": dict(keywords),
        "corridor": corridor.name,
        "estimator": config.estimator,
        "epsilon": config.privacy.epsilon,
        "versions": {name: version(name) for name in ("dptse-env", "stable-baselines3", "torch")},
        "training": dict(training),
        "figures": dict(figures),
    }
    kept = io.BytesIO()
    torch.save(dict(policy.state_dict()), kept)
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry, content in (
            (CARD, json.dumps(card, indent=2) + "\n"),
            (TEXT, _text(card)),
            (WEIGHTS, kept.getvalue()),
        ):
            # A fixed date: the same policy gives the same file.
            archive.writestr(zipfile.ZipInfo(entry), content, zipfile.ZIP_DEFLATED)
    aside = target.with_suffix(".tmp")
    try:
        aside.write_bytes(whole.getvalue())
        aside.replace(target)
    finally:
        aside.unlink(missing_ok=True)


def load_policy(
    source: str | os.PathLike[str], env: Any, *, allow: Collection[str] = ()
) -> SavedPolicy:
    """Load a policy for an environment.

    Args:
        source: A file, or the name of a policy that comes with the package
            (`dptse_env.policies`).
        env: The environment in which it is to act: of this package, scalar or vector, wrapped or
            not, or as an `SB3VecEnv`.
        allow: What may differ on purpose, of `TRANSFERABLE`. Estimator, privacy and traffic model
            may always differ.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is no saved policy, or the policy does not fit the environment: the
            message names what each of them has.
    """
    strangers = [name for name in allow if name not in TRANSFERABLE]
    if strangers:
        raise ValueError(f"allow must be of {', '.join(TRANSFERABLE)}, got {strangers[0]!r}")
    content, config = read_policy(source), _config_of(env)
    card, weights = _unpack(content, str(source))
    there, here = card["fits"], fit_of(config)
    differing = [
        f"{key} is {there.get(key)!r} of the policy and {here[key]!r} of the environment"
        for key in MUST_FIT
        if there.get(key) != here[key] and key not in allow
    ]
    if differing:
        raise ValueError(
            f"policy {str(source)!r} does not fit: {'; '.join(differing)}{_hint(allow)}"
        )
    interface = QueryInterface.of(config)
    made = card["policy"]
    policy = _KINDS[made["class"]].make(config, interface, made["arguments"])
    absent = policy.load_state_dict(weights, strict=False).missing_keys
    if absent:
        raise ValueError(f"policy {str(source)!r} lacks weights: {', '.join(absent)}")
    policy.set_training_mode(False)
    return SavedPolicy(policy, card, interface)


def _hint(allow: Collection[str]) -> str:
    left = [name for name in TRANSFERABLE if name not in allow]
    return f". Transfer on purpose: allow={tuple(left)!r} or some of it" if left else ""


def _unpack(content: bytes, source: str) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return card and weights of a file's content."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            card: dict[str, Any] = json.loads(archive.read(CARD))
            weights = torch.load(io.BytesIO(archive.read(WEIGHTS)), weights_only=True)
        known = card["policy"]["class"] in _KINDS and isinstance(card["fits"], dict)
    except pickle.UnpicklingError as problem:
        raise ValueError(f"{source!r} holds more than weights and is not loaded") from problem
    except (zipfile.BadZipFile, KeyError, ValueError, RuntimeError, EOFError) as problem:
        raise ValueError(f"{source!r} is no saved policy, or damaged: {problem}") from problem
    if not known:
        raise ValueError(f"{source!r} holds a policy of an unknown class")
    return card, weights


def _config_of(env: Any) -> EnvConfig:
    base = env.unwrapped
    config = getattr(base, "config", None) or getattr(getattr(base, "env", None), "config", None)
    if not isinstance(config, EnvConfig):
        raise ValueError(f"env must be an environment of this package, got {env}")
    return config


def _text(card: Mapping[str, Any]) -> str:
    """Return the card for people."""
    fits, training = card["fits"], card["training"]
    lines = [
        f"# {card['policy']['class']} for {card['env'].rpartition(':')[2]}",
        "",
        f"Chooses {fits['bandwidth']} segments a second on corridor {card['corridor']} "
        f"(action encoding `{fits['action']}`), trained with estimator {card['estimator']} at "
        f"epsilon {card['epsilon']:g}.",
        "",
        "It sees released values, the estimator's output and the query history, and no truth; an "
        "episode's guarantee of privacy is that of the environment's mechanism, whatever it asks. "
        "It was trained on simulated traffic and has not been tried on a real road.",
        "",
        "| | |",
        "|---|---|",
    ]
    rows = {**{f"training: {k}": v for k, v in training.items()}, **card["figures"]}
    rows |= {f"version: {name}": number for name, number in card["versions"].items()}
    lines += [f"| {name} | {_shown(value)} |" for name, value in rows.items()]
    return "\n".join(lines) + "\n"


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value).replace("|", "\\|")
