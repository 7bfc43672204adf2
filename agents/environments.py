"""Environments by id and keywords, scalar and vectorised, and keywords from command lines."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from dptse_env.config import KEYWORDS, PRESETS, EnvConfig
from dptse_env.estimators.recurrent import weights_of
from dptse_env.estimators.tuned import PUBLISHED
from dptse_env.evaluation import require_in_step
from dptse_env.model import available_parameters
from dptse_env.parts import privacy_report
from dptse_env.privacy import rounded_up
from dptse_env.registration import ENVIRONMENTS
from dptse_env.release import RELEASE_MODELS
from dptse_env.utils.validation import parse_json, require
from dptse_env.vector_env import SensorQueryVectorEnv

LONGEST = 40
"""Letters of a value that a heading shows."""

PAPER, PRIVATE, LONG, SHORT = (f"dptse_env:{env}" for env in ENVIRONMENTS)
"""Ids of the package's environments, as `gymnasium.make` takes them."""

OTHER_DRIVERS: dict[str, Any] = {
    "corridor": {"drivers": {"model": "Krauss"}},
    "demand": {
        "base": {
            "mainline": [[0.0, 5000.0], [120.0, 2000.0], [300.0, 5600.0], [420.0, 3000.0]],
            "on_ramps": [150.0, 600.0],
        }
    },
}
"""Keywords of drivers and demand that no policy was trained on."""


def parse_env(text: str) -> tuple[str, dict[str, Any]]:
    """Return the id and the keywords of an environment given as ``ID`` or ``ID {JSON}``.

    Raises:
        ValueError: There is no such environment, or what follows its id is no JSON object.
    """
    env, _, rest = text.strip().partition(" ")
    module, _, name = env.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        spec = gym.spec(name)
    except (gym.error.Error, ModuleNotFoundError):
        spec = None
    except Exception as problem:
        raise ValueError(
            f"env: {module!r} cannot be imported: {type(problem).__name__}: {problem}"
        ) from problem
    known = ", ".join(ENVIRONMENTS)
    is_own = spec is not None and "preset" in spec.kwargs
    require(is_own, "env", f"the id of an environment of this package, as {known}", env)
    keywords = parse_json(rest or "{}", "env")
    require(isinstance(keywords, dict), "env", "an id and a JSON object", rest)
    return env, keywords


def preset_of(env: str) -> str:
    """Return the name of the preset of an environment that `parse_env` has found."""
    return str(gym.spec(env.rpartition(":")[2]).kwargs["preset"])


def make_config(env: str, keywords: Mapping[str, Any]) -> EnvConfig:
    """Return the configuration of an environment.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    made = gym.make(env, disable_env_checker=True, **keywords)
    config: EnvConfig = made.get_wrapper_attr("config")
    return config


def make_vector(env: str, n_episodes: int, keywords: Mapping[str, Any]) -> SensorQueryVectorEnv:
    """Make a vector environment of whole episodes, which do not begin anew.

    Raises:
        ValueError: A keyword is unknown or out of range, or the decisions of a second may take
            different numbers of actions, so that episodes would not stay in step.
    """
    made = gym.make_vec(
        env, num_envs=n_episodes, **{**keywords, "autoreset_mode": AutoresetMode.DISABLED}
    )
    assert isinstance(made, SensorQueryVectorEnv)
    require_in_step(made)
    return made


INTERFACE = ("action", "observation", "traffic_seeds", "truth_in_info")
"""Keywords that say what a policy is shown and how it answers, but change no error."""


CONDITIONS = {"demand", "incident"}
"""Keywords that change a road."""


NAMED = ("bandwidth", "query_every")
"""Keywords that a heading names in any case."""


def heading(env: str, keywords: Mapping[str, Any]) -> str:
    """Return an environment in words: what an error depends on, and all that is not its default.

    Parameters, the release model with its losses, penetration, queries and sensors are named in any
    case. The estimator is left to what stands below the heading; `settings_of` has its settings.

    Args:
        env: Id of the environment.
        keywords: Its keywords.
    """
    with quietly():
        config = make_config(env, keywords)
    default, privacy = PRESETS[preset_of(env)], config.privacy
    road, share = config.corridor, config.penetration.share
    sensors = ", ".join(map(str, road.fixed_sensors))
    said = [
        env.rpartition("/")[2],
        *([] if road.name == default.corridor.name else [f"road {road.name}"]),
        f"parameters {config.parameters.name}",
        release_in_words(config),
        f"penetration {' to '.join(f'{each:g}' for each in np.atleast_1d(share))}",
        *(f"{name} {getattr(config, name)}" for name in NAMED),
        f"fixed sensors {sensors}" if sensors else "no fixed sensors",
        str(road.loops or "no loops"),
    ]
    own = default.corridor
    if road.name != own.name:
        others = {name: value for name, value in keywords.items() if name not in CONDITIONS}
        with quietly():
            own = make_config(env, others).corridor
    said += _differences("corridor", road.fields(), own.fields())
    expected = RELEASE_MODELS.find(privacy.preset).settings_type(
        preset=privacy.preset, epsilon=privacy.epsilon, delta=privacy.delta
    )
    said += _differences("privacy", vars(privacy), vars(expected))
    for name in KEYWORDS:
        if name not in ("corridor", "privacy", "parameters", "estimator", *NAMED, *INTERFACE):
            value, other = getattr(config, name), getattr(default, name)
            if dataclasses.is_dataclass(value) and type(value) is type(other):
                said += _differences(name, vars(value), vars(other))
            else:
                said += _differences("", {name: value}, {name: other})
    return ", ".join(said)


def release_in_words(config: EnvConfig) -> str:
    """Return the release model of an environment, with epsilon and delta."""
    privacy = config.privacy
    losses = f"epsilon {rounded_up(privacy.epsilon)}, delta {rounded_up(privacy.delta)}"
    return f"release model {RELEASE_MODELS.name_of(privacy.preset)} ({losses})"


GUARANTEE = "guarantee"
"""Column of what `guarantee_of` gives."""


def guarantee_of(env: str, keywords: Mapping[str, Any]) -> str:
    """Return epsilon and delta of an environment's guarantee for a table, or "none"."""
    with quietly():
        config = make_config(env, keywords)
    if privacy_report(config).guarantee == "none":
        return "none"
    return f"ε = {rounded_up(config.privacy.epsilon)}, δ = {rounded_up(config.privacy.delta)}"


def settings_of(env: str, keywords: Mapping[str, Any]) -> str:
    """Return the estimator's settings in force in words, with the name of a set, or of weights."""
    with quietly():
        config = make_config(env, keywords)
    if config.settings_name is not None:
        return f"{_origin(config.settings_name)} ({config.settings_name})"
    if config.estimator == "recurrent":
        saved = weights_of(config.settings(), flows=config.releases_flow)
        return f"weights {saved.source}"
    if config.estimator_settings is None:
        return "defaults"
    given = keywords.get("estimator_settings", "those of the road file")
    return given if isinstance(given, str) else "its own"


def _origin(name: str) -> str:
    """Return in words what a shipped set was tuned for, which its name has piece by piece."""
    rest = name.partition("-")[2]
    parameters = next(each for each in available_parameters() if rest.startswith(f"{each}-"))
    release, _, variant = rest.removeprefix(f"{parameters}-").partition("-")
    if variant == PUBLISHED:
        return f"as the paper has them, for {release}"
    road = f" on {variant}" if variant else ""
    return f"tuned with the parameters {parameters} for {release}{road}"


ELSEWHERE = {"corridor.loops", "corridor.fixed_sensors", "penetration.share"}
"""Values that a heading has in words of their own."""


def _differences(path: str, own: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the values that differ from others, by path; of long ones the path alone."""
    found = []
    for name, value in own.items():
        place = f"{path}.{name}" if path else name
        if place not in ELSEWHERE and value != other.get(name):
            words = getattr(value, "__name__", str(value))
            found.append(f"{place} {words}" if len(words) <= LONGEST else f"another {place}")
    return found


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Suppress warnings of a void guarantee and of other traffic.

    A study reports the guarantee itself, and may be about traffic for which nothing was tuned.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"privacy\.preset is .* yet no privacy")
        warnings.filterwarnings("ignore", message=".*values measured or tuned on")
        yield
