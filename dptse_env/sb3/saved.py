"""Trained policies as small files, which are checked against the environment when loaded."""

import io
import json
import os
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy

from dptse_env.config import EnvConfig
from dptse_env.estimators import ESTIMATORS
from dptse_env.parts import QueryInterface, make_interface
from dptse_env.policies import CARD, TRANSFERABLE, WEIGHTS, PolicyFile, parse_policy, read_policy
from dptse_env.sb3.fit import TrainedOn, check_fit, make_fit
from dptse_env.sb3.kinds import KINDS, Shapes
from dptse_env.utils.arrays import Action, BoolArray, Observation

CARD_TEXT = "CARD.md"
"""Entry of a policy file with the readable card."""


class ActingPolicy:
    """A policy of stable-baselines3 that acts by observations alone.

    Attributes:
        interface: Interface of its environment.
    """

    def __init__(self, policy: BasePolicy, interface: QueryInterface) -> None:
        """Bind a policy to an environment's interface."""
        self._policy, self.interface = policy, interface
        # A maskable policy expects masks as an argument; they are part of the observation.
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


class SavedPolicy(ActingPolicy):
    """A trained policy with the ``predict`` of stable-baselines3.

    Attributes:
        card: Description of the policy, its training, and the environments it fits.
        trained_on: The road that it was trained on.
        interface: Interface of its environment.
    """

    def __init__(
        self, policy: BasePolicy, card: Mapping[str, Any], interface: QueryInterface
    ) -> None:
        """Bind a policy to its card and to an environment's interface."""
        super().__init__(policy, interface)
        self.card, self.trained_on = dict(card), TrainedOn.from_card(card)


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
        path: A file that ends in ``.zip``.
        policy: One of `PlackettLucePolicy`, ``ActorCriticPolicy``, ``MaskableActorCriticPolicy``.
        config: Configuration of the environment that it was trained on.
        env: Id of that environment.
        keywords: Keywords of that environment, plain JSON.
        training: Recipe, seeds, steps; plain JSON.
        figures: Results, by name; plain JSON.

    Raises:
        ValueError: The policy could not be loaded again: it is of another class, has additional
            parts, is too large, or has weights that are not finite. Or the path does not end
            in ``.zip``.
        OSError: The file cannot be written.
    """
    target = Path(path)
    name = type(policy).__name__
    if name not in KINDS:
        raise ValueError(f"policy must be one of {', '.join(KINDS)}, got {name}")
    if target.suffix != ".zip":
        raise ValueError(f"path must end in .zip, got {str(path)!r}")
    kind = KINDS[name]
    arguments = kind.describe(policy)
    card = {
        "fits": make_fit(config, kind),
        "policy": {"class": name, "arguments": arguments},
        "env": env,
        "keywords": dict(keywords),
        "corridor": config.corridor.name,
        "trained_on": asdict(TrainedOn.from_corridor(config.corridor)),
        "estimator": ESTIMATORS.name_of(config.estimator),
        "epsilon": config.privacy.epsilon,
        "versions": {name: version(name) for name in ("dptse-env", "stable-baselines3", "torch")},
        "training": dict(training),
        "figures": dict(figures),
    }
    content = _packed(card, policy)
    try:
        _check_weights(parse_policy(content, str(path)), kind.shapes(config, arguments))
    except ValueError as problem:
        raise ValueError(f"policy cannot be saved: {problem}") from problem
    temporary = target.with_suffix(".tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def load_policy(
    source: str | os.PathLike[str], env: Any, *, allow: Collection[str] = ()
) -> SavedPolicy:
    """Load a policy for an environment.

    No code in the file is run. Its size, its values and the shapes of its network are checked
    before anything is built (`dptse_env.policies.reading`).

    Args:
        source: A file, or the name of a policy that comes with the package
            (`dptse_env.policies`).
        env: The environment in which it acts: of this package, scalar or vector, wrapped or not,
            or as an `SB3VecEnv`.
        allow: Properties that may differ on purpose, of `TRANSFERABLE`. Estimator, privacy and
            traffic model may always differ. With ``"corridor"`` a `PlackettLucePolicy` acts on
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
    config = _config_of(env)
    file = read_policy(source)
    try:
        return _bind(file, config, allow)
    except ValueError as problem:
        raise ValueError(f"policy {file.source!r} cannot be loaded: {problem!s:.1000}") from problem


def _bind(file: PolicyFile, config: EnvConfig, allow: Collection[str]) -> SavedPolicy:
    """Make the policy of a file for an environment of ``config``.

    Raises:
        ValueError: It does not fit, or its card and its weights do not agree.
    """
    name, arguments = (file.card["policy"][key] for key in ("class", "arguments"))
    if name not in KINDS:
        raise ValueError(f"its class must be one of {', '.join(KINDS)}, got {name!r}")
    kind = KINDS[name]
    check_fit(file.card, kind, config, allow)
    _check_weights(file, kind.shapes(config, arguments))
    # The random initial weights are replaced; torch's generator is left unchanged.
    with torch.random.fork_rng(devices=[]):
        policy = kind.make(config, arguments)
    weights = {name: torch.from_numpy(array) for name, array in file.weights.items()}
    policy.load_state_dict(weights)
    policy.set_training_mode(False)
    return SavedPolicy(policy, file.card, make_interface(config))


def _check_weights(file: PolicyFile, shapes: Shapes) -> None:
    """Refuse weights that are not exactly those of the network that a card describes."""
    found = {name: array.shape for name, array in file.weights.items()}
    missing = [name for name in shapes if name not in found]
    unknown = [name for name in found if name not in shapes]
    for problem, names in (("lacks weights", missing), ("has unknown weights", unknown)):
        if names:
            raise ValueError(f"it {problem} {', '.join(map(repr, names[:5]))}")
    for name, shape in shapes.items():
        if found[name] != shape:
            raise ValueError(f"weight {name!r} must have shape {shape}, got {found[name]}")


def _packed(card: Mapping[str, Any], policy: BasePolicy) -> bytes:
    """Return the content of a policy file."""
    weights = io.BytesIO()
    torch.save({k: v.detach().cpu().contiguous() for k, v in policy.state_dict().items()}, weights)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, entry in (
            (CARD, json.dumps(card, indent=2) + "\n"),
            (CARD_TEXT, _text(card)),
            (WEIGHTS, weights.getvalue()),
        ):
            # ZipInfo has a fixed date, so that the same policy gives the same file.
            archive.writestr(zipfile.ZipInfo(name), entry, zipfile.ZIP_DEFLATED)
    return content.getvalue()


def _config_of(env: Any) -> EnvConfig:
    base = env.unwrapped
    config = getattr(base, "config", None) or getattr(getattr(base, "env", None), "config", None)
    if not isinstance(config, EnvConfig):
        raise ValueError(f"env must be an environment of this package, got {env}")
    return config


def _text(card: Mapping[str, Any]) -> str:
    """Return the readable card."""
    fits, training = card["fits"], card["training"]
    lines = [
        f"# {card['policy']['class']} for {card['env'].rpartition(':')[2]}",
        "",
        f"Chooses {_shown_bandwidth(fits)} a second on corridor {TrainedOn.from_card(card)} "
        f"(action encoding `{fits['action']}`), trained with estimator {card['estimator']} at "
        f"epsilon {card['epsilon']:g}.",
        "",
        "It observes released values, the estimator's output and the query history, and no truth; "
        "an episode's guarantee of privacy is that of the environment's mechanism, whatever the "
        "policy queries. It was trained on simulated traffic and has not been tried on real roads.",
        "",
        "| | |",
        "|---|---|",
    ]
    rows = {**{f"training: {k}": v for k, v in training.items()}, **card["figures"]}
    rows |= {f"version: {name}": number for name, number in card["versions"].items()}
    lines += [f"| {name} | {_shown(value)} |" for name, value in rows.items()]
    return "\n".join(lines) + "\n"


def _shown_bandwidth(fits: Mapping[str, Any]) -> str:
    if "queries" not in fits:
        return f"{fits['bandwidth']} segments"
    return f"queries for a bandwidth of {fits['bandwidth']} ({fits['queries']})"


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value).replace("|", "\\|")
