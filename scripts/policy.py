r"""Turn a model of stable-baselines3 or sb3-contrib into a saved policy.

dptse policy import model.zip --vecnormalize vecnormalize.pkl \
    --env dptse_env:dptse/ShortHighway-v0 --keywords '{"bandwidth": 1}' \
    --output mine.safetensors --trust

Reading a model unpickles it, which can run any code: --trust is your word that you know where it is
from. The file that it becomes holds numbers alone, and dptse evaluate and dptse suite take it.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium as gym
from gymnasium import spaces
from tyro.conf import Positional

from agents.environments import make_config, parse_env
from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface
from dptse_env.policies import DETERMINISTIC, SUFFIX
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import parse_json, require

ENCODINGS: dict[type[gym.Space[Any]], str] = {
    spaces.MultiBinary: "mask",
    spaces.Box: "scores",
    spaces.MultiDiscrete: "slots",
    spaces.Discrete: "sequential",
}
"""Action encoding by the type of its space."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Turn a model of stable-baselines3 or sb3-contrib into a saved policy."""

    verb: Annotated[Literal["import"], Positional]
    """The one action: import."""
    model: Annotated[Path, Positional]
    """The model, a .zip file."""
    output: Path
    """File to write, .safetensors."""
    env: str
    """Environment that it was trained in: an id, or an id and keywords as JSON."""
    keywords: str = "{}"
    """Keywords of that environment, JSON; action, if not given, by the model's action space."""
    vecnormalize: Path | None = None
    """The statistics of VecNormalize, .pkl, if it was trained with any."""
    acts: Literal["deterministic", "drawn"] = "deterministic"
    """Mode of its actions: the likeliest, or drawn ones."""
    trust: bool = False
    """Unpickle the files, which can run any code that is in them."""
    force: bool = False
    """Replace a file that is there."""


def main(args: Args) -> None:
    """Read the model, check that it fits the environment, and write the policy."""
    require(args.trust, "trust", "given, since reading the model can run code in it", args.trust)
    for path in (args.model, args.vecnormalize):
        if path is not None and not path.is_file():
            raise FileNotFoundError(f"there is no file {path}")
    require(args.output.suffix == SUFFIX, "output", f"a {SUFFIX} file", str(args.output))
    keywords = parse_json(args.keywords, "keywords")
    require(isinstance(keywords, dict), "keywords", "a JSON object", args.keywords)
    env, own = parse_env(args.env)
    keywords |= own
    make_config(env, keywords)
    require_output(args.output.parent, [args.output.name], force=args.force)
    policy, about = _unpickled(args.model, _read_model)
    kind = type(policy.action_space)
    require(kind in ENCODINGS, "model", "one whose action space an encoding has", kind.__name__)
    keywords = {"action": ENCODINGS[kind], **keywords}
    config = make_config(env, keywords)
    _check_spaces(policy, config)
    scaled = None if args.vecnormalize is None else _unpickled(args.vecnormalize, _read_statistics)
    from dptse_env.sb3 import save_policy  # noqa: PLC0415

    save_policy(
        args.output,
        policy,
        config,
        env=env,
        keywords={key: value for key, value in keywords.items() if key != "action"},
        training=about,
        figures={},
        normalisation=scaled,
        deterministic=args.acts == DETERMINISTIC,
    )
    print(f"{args.output} is a {type(policy).__name__} of action encoding {config.action!r}")


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
