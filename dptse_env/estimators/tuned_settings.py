"""Tuned estimator settings: named sets that ship with the package, and files of the same format.

A set has the settings tuned for an estimator with an ARZ parameter set under a privacy preset;
others keep the defaults of `EstimatorSettings`. ``scripts/tune.py`` makes them.
"""

import json
import warnings
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.utils.fields import from_mapping
from dptse_env.utils.json_object import parse_object, shipped_texts

_PATH = "estimator_settings"
_KEYS = {
    "name": str,
    "estimator": str,
    "parameters": str,
    "privacy": str,
    "settings": dict,
    "provenance": dict,
}


def settings_name(estimator: str, parameters: str, privacy: str) -> str:
    """Return the name of the set for an estimator, an ARZ parameter set and a privacy preset."""
    return f"{estimator}-{parameters}-{privacy}"


@cache
def _shipped() -> dict[str, str]:
    return shipped_texts("dptse_env.estimators", "tuned")


def available_settings() -> tuple[str, ...]:
    """Names of the sets that ship with the package, sorted."""
    return tuple(_shipped())


def load_settings(name: str) -> EstimatorSettings:
    """Load a set that ships with the package.

    Raises:
        ValueError: There is no such set; the message lists the available ones.
    """
    return _load(known_settings(name))


def known_settings(name: str) -> str:
    """Return the name of a set that ships with the package, given its present or former name.

    Raises:
        ValueError: There is no such set; the message lists the available ones.
    """
    if name in available_settings():
        return name
    present = name.removesuffix("-guaranteed") + "-capped"
    if name.endswith("-guaranteed") and present in available_settings():
        message = f"{_PATH}: {name!r} is now called {present!r}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return present
    raise ValueError(f"{_PATH} must be one of {', '.join(available_settings())}, got {name!r}")


@cache
def _load(name: str) -> EstimatorSettings:
    return _parse(_shipped()[name], name)


def read_settings(path: str | Path) -> EstimatorSettings:
    """Read a set from a JSON file, as written by `write_settings`.

    Raises:
        ValueError: The file has another format, or a setting is out of range; the message starts
            with the path of the file.
    """
    return _parse(Path(path).read_bytes(), str(path))


def tuned_estimator(path: str | Path) -> str:
    """Return the estimator that the set in a JSON file was tuned for.

    Raises:
        ValueError: The file has another format.
    """
    return str(parse_object(Path(path).read_bytes(), str(path), _KEYS)["estimator"])


def write_settings(
    path: str | Path,
    *,
    estimator: str,
    parameters: str,
    privacy: str,
    settings: Mapping[str, Any],
    provenance: Mapping[str, Any],
    variant: str = "",
) -> None:
    """Write the tuned fields of `EstimatorSettings` and their provenance as JSON.

    A variant is an ending of the set's name, beside the default set of a privacy preset.

    Raises:
        ValueError: A setting is unknown or out of range; nothing is written then.
    """
    name = settings_name(estimator, parameters, privacy)
    content = {
        "name": f"{name}-{variant}" if variant else name,
        "estimator": estimator,
        "parameters": parameters,
        "privacy": privacy,
        "settings": dict(settings),
        "provenance": dict(provenance),
    }
    text = json.dumps(content, indent=2) + "\n"
    _parse(text, str(path))
    Path(path).write_text(text, encoding="utf-8")


def _parse(text: str | bytes, path: str) -> EstimatorSettings:
    content = parse_object(text, path, _KEYS)
    name = settings_name(content["estimator"], content["parameters"], content["privacy"])
    if content["name"] != name and not content["name"].startswith(f"{name}-"):
        raise ValueError(
            f"{path}: name must be {name!r} or begin with '{name}-', got {content['name']!r}"
        )
    try:
        return from_mapping(EstimatorSettings, content["settings"], _PATH)
    except ValueError as problem:
        raise ValueError(f"{path}: {problem}") from problem
