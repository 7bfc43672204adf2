"""Tuned settings of the estimators: those that ship, files of others, which an environment gets.

``tuned.json`` has a table by name: ``<estimator>-<ARZ parameters>-<privacy preset>``, and for those
of a road that with its name at the end. Those of the paper's filters, as the paper has them, end in
``published``. ``dptse fit --tune`` writes a file with one such entry, which the keyword
``estimator_settings`` takes. What an entry leaves out has the value of `EstimatorSettings`.
"""

import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from dptse_env.estimators.settings import PATH, EstimatorSettings
from dptse_env.model import ARZParameters, available_parameters, load_parameters
from dptse_env.utils.validation import check_object, cut, from_mapping, read_json, shown, within

_KEYS = {"estimator": str, "settings": dict, "provenance": dict}

DEFAULT_PARAMETERS = "w99-3lane"
"""ARZ parameters whose tuned settings hold for parameters that do not say what they come from:
those fitted to simulated traffic, which predict it about as well as others that are fitted."""

PUBLISHED = "published"
"""Name of the paper's filters as the paper has them, for all parameters and release models."""


def tuned_settings(
    estimator: Any, parameters: ARZParameters, preset: Any, variant: str = ""
) -> str | None:
    """Return the name of the shipped settings that an environment gets unless it names others.

    Those of a variant come before those without. Parameters of one's own get those of the shipped
    set that `tuned_with` names.

    Args:
        estimator: Name of the estimator, or a part of another package, which has none.
        parameters: The ARZ parameters of its model.
        preset: The privacy preset, or a part of another package, which has none.
        variant: Name of the road, where there may be settings for it alone.

    Returns:
        The name; None where none ship, so that the defaults of the estimator's settings hold.
    """
    if not isinstance(estimator, str) or not isinstance(preset, str):
        return None
    names = [settings_name(estimator, tuned_with(parameters), preset, v) for v in (variant, "")]
    return next((name for name in names if name in _table()), None)


def published_settings(estimator: Any, parameters: ARZParameters, preset: Any) -> str:
    """Return the name of the shipped settings of one of the paper's filters, as the paper has them.

    Args:
        estimator: Name of the estimator.
        parameters: The ARZ parameters of its model; see `tuned_settings`.
        preset: The privacy preset.

    Raises:
        ValueError: The paper has no such filter, or it was not tuned for this release model.
    """
    name = settings_name(str(estimator), tuned_with(parameters), str(preset), PUBLISHED)
    if name not in _table():
        filters = {
            at["estimator"] for each, at in _table().items() if each.endswith(f"-{PUBLISHED}")
        }
        raise ValueError(
            f"{PATH} may be {PUBLISHED!r} for {', '.join(sorted(filters))} with a release model of "
            f"the package alone, got {shown(estimator)} with {shown(preset)}"
        )
    return name


def tuned_with(parameters: ARZParameters) -> str:
    """Return the name of the shipped ARZ parameters whose tuned settings hold for these."""
    if parameters in map(load_parameters, available_parameters()):
        return parameters.name
    return parameters.derived_from or DEFAULT_PARAMETERS


def is_tuned(estimator: Any) -> bool:
    """Return whether tuned settings ship for an estimator, be it with other parts than its own."""
    return any(entry["estimator"] == estimator for entry in _table().values())


def is_of_another_road(name: str, road: str) -> bool:
    """Return whether settings are not those of a road for which some were tuned by its name."""
    end = f"-{road}"
    return not name.endswith(end) and any(each.endswith(end) for each in _table())


def settings_name(estimator: str, parameters: str, privacy: str, variant: str = "") -> str:
    """Return the name of tuned settings."""
    return "-".join((estimator, parameters, privacy, *((variant,) if variant else ())))


def available_settings() -> tuple[str, ...]:
    """Names of the tuned settings that ship with the package, sorted."""
    return tuple(sorted(_table()))


@cache
def load_settings(name: str) -> EstimatorSettings:
    """Load tuned settings that ship with the package.

    Raises:
        ValueError: There are none of this name; the message lists the available ones.
    """
    if name not in _table():
        known = ", ".join(available_settings())
        raise ValueError(f"{PATH} must be {PUBLISHED!r} or one of {known}, got {shown(name)}")
    return _parse(_table()[name], name)


def read_settings(path: str | Path) -> EstimatorSettings:
    """Read tuned settings from a JSON file, as written by `write_settings`.

    Raises:
        ValueError: The file cannot be read, has another format, a setting is out of range, or an
            expert is named by an import string; the message starts with the path of the file.
    """
    return _parse(_entry(read_json(path), str(path)), str(path))


def tuned_estimator(path: str | Path) -> str:
    """Return the estimator that the settings in a JSON file were tuned for.

    Raises:
        ValueError: The file cannot be read, or has another format.
    """
    return str(_entry(read_json(path), str(path))["estimator"])


def write_settings(
    path: str | Path,
    *,
    estimator: str,
    parameters: str,
    privacy: str,
    settings: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> None:
    """Write tuned fields of `EstimatorSettings` and how they were tuned as JSON.

    Raises:
        ValueError: A setting is unknown or out of range; nothing is written then.
    """
    entry = {
        "estimator": estimator, "settings": dict(settings), "provenance": dict(provenance),
    }  # fmt: skip
    name = settings_name(estimator, parameters, privacy)
    text = json.dumps({name: entry}, indent=2) + "\n"
    _parse(_entry(json.loads(text), str(path)), str(path))
    Path(path).write_text(text, encoding="utf-8")


@cache
def _table() -> dict[str, dict[str, Any]]:
    text = (files(__package__) / "tuned.json").read_text(encoding="utf-8")
    table: dict[str, dict[str, Any]] = json.loads(text)
    return table


def _entry(content: Any, path: str) -> dict[str, Any]:
    """Return the entry of a file that has one."""
    if not isinstance(content, dict) or len(content) != 1:
        raise ValueError(
            f"{path} must be a mapping with one name of settings, got {shown(content)}"
        )
    ((name, entry),) = content.items()
    return check_object(entry, f"{path}: {cut(name)}", _KEYS)


def _parse(entry: Mapping[str, Any], path: str) -> EstimatorSettings:
    with within(f"{path}: "):
        return from_mapping(EstimatorSettings, entry["settings"], PATH)
