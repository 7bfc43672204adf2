"""Models of stable-baselines3 and sb3-contrib, which become saved policies.

Reading a model unpickles it, which can run any code. The file that it becomes holds numbers alone.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from agents.environments import make_config
from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface
from dptse_env.utils.validation import require

ENCODINGS: dict[type[gym.Space[Any]], str] = {
    spaces.MultiBinary: "mask",
    spaces.Box: "scores",
    spaces.MultiDiscrete: "slots",
    spaces.Discrete: "sequential",
}
"""Action encoding by the type of its space."""


def import_model(
    model: Path,
    vecnormalize: Path | None,
    env: str,
    keywords: Mapping[str, Any],
    output: Path,
    *,
    deterministic: bool,
) -> dict[str, str]:
    """Read a model, check that it fits the environment, and write it as a saved policy.

    Args:
        model: The model, a .zip file.
        vecnormalize: The statistics of VecNormalize, .pkl, if it was trained with any.
        env: Id of the environment that it was trained in.
        keywords: Keywords of that environment; ``action``, if not given, by its action space.
        output: The file to write.
        deterministic: Whether it takes the likeliest actions, or drawn ones.

    Returns:
        The ``class`` of the policy, and its encoding of ``action``.

    Raises:
        ValueError: A file cannot be read, or the model does not fit the environment.
    """
    policy, about = _unpickled(model, _read_model)
    kind = type(policy.action_space)
    require(kind in ENCODINGS, "model", "one whose action space an encoding has", kind.__name__)
    config = make_config(env, {"action": ENCODINGS[kind], **keywords})
    _check_spaces(policy, config)
    scaled = None if vecnormalize is None else _unpickled(vecnormalize, _read_statistics)
    from dptse_env.sb3 import save_policy  # noqa: PLC0415

    output.parent.mkdir(parents=True, exist_ok=True)
    save_policy(
        output,
        policy,
        config,
        env=env,
        keywords={key: value for key, value in keywords.items() if key != "action"},
        training={"traffic seeds": "not said", **about},
        figures={},
        normalisation=scaled,
        deterministic=deterministic,
    )
    return {"class": type(policy).__name__, "action": config.action}


def _unpickled(path: Path, read: Callable[[Path], Any]) -> Any:
    """Read a file; whatever its code raises is a `ValueError` that names it."""
    try:
        return read(path)
    except Exception as problem:
        said = " ".join(f"{type(problem).__name__}: {problem}".split())
        raise ValueError(f"{path} cannot be read: {said:.300}") from problem


def _read_model(path: Path) -> tuple[Any, dict[str, Any]]:
    """Return the policy of a model, and what it tells of its training."""
    from stable_baselines3.common.save_util import load_from_zip_file  # noqa: PLC0415

    data, parameters, _ = load_from_zip_file(path, device="cpu")
    assert data is not None
    given = dict(data["policy_kwargs"])
    if data.get("use_sde"):
        given["use_sde"] = True
    make, places = data["policy_class"], (data["observation_space"], data["action_space"])
    policy = make(*places, lambda _: 0.0, **given)
    policy.load_state_dict(parameters["policy"])
    seed, steps = data.get("seed"), data.get("num_timesteps", 0)
    return policy, {"learner": "imported", "seed": int(seed or 0), "steps": int(steps)}


def _read_statistics(path: Path) -> Any:
    from stable_baselines3.common.vec_env import VecNormalize  # noqa: PLC0415

    found = pickle.loads(path.read_bytes())
    if not isinstance(found, VecNormalize):
        raise TypeError(f"it must be a VecNormalize, got {type(found).__name__}")
    return found


def _check_spaces(policy: Any, config: EnvConfig) -> None:
    """Refuse a model whose spaces are not those of the environment."""
    interface = make_interface(config)
    own, here = policy.observation_space.shape, interface.observations.space.shape
    require(own == here, "model.observation_space", f"of shape {here} as the environment's", own)
    actions, there = policy.action_space, interface.actions.space
    require(actions == there, "model.action_space", f"{there} as the environment's", actions)
