"""Provenance of a folder of results: what it was made with; other results are refused there."""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dptse_env
from agents.evaluation.episodes import WARM_UP
from agents.experiments.cells import Design
from agents.files import write_json
from dptse_env.config import EnvConfig
from dptse_env.estimators.tuned_settings import available_settings, settings_name
from dptse_env.utils.digests import package_digest

PROVENANCE_FILE = "run.json"


def design_provenance(design: Design[Any]) -> dict[str, Any]:
    """Return the provenance of a design's results.

    Raises:
        ValueError: A cell of the design is out of range; the message names the value.
    """
    environment = environment_provenance(design.env, design.schedule, design.configs)
    return results_provenance(environment, design.configs)


def environment_provenance(env: str, schedule: str, configs: Sequence[EnvConfig]) -> dict[str, Any]:
    """Return versions, traffic and models behind results of one environment, as plain JSON."""
    parameters = {each.name: each for each in (config.arz_parameters for config in configs)}
    return {
        "versions": {name: version(name) for name in ("dptse-env", "libsumo")},
        "env": env,
        "corridor": configs[0].corridor.digest,
        "schedule": schedule,
        "warm_up": WARM_UP,
        "parameters": {name: dataclasses.asdict(each) for name, each in parameters.items()},
    }


def results_provenance(
    made_with: Mapping[str, Any], configs: Sequence[EnvConfig]
) -> dict[str, Any]:
    """Return everything but cells and seeds that results depend on, as plain JSON.

    ``made_with`` must agree for results to stand in one folder; the estimators' settings are added
    to it. ``tuned`` names the settings that come from a shipped set. ``sources`` (states of the
    package's code) and ``machine`` are for the record.
    """
    settings = {_name_of_settings(each): dataclasses.asdict(each.settings()) for each in configs}
    content = {
        "made_with": {**made_with, "settings": settings},
        "tuned": sorted(settings.keys() & available_settings()),
        "sources": [source_digest()],
        "machine": machine(("gymnasium", "numba", "numpy", "scipy")),
    }
    plain: dict[str, Any] = json.loads(json.dumps(content))
    return plain


def _name_of_settings(config: EnvConfig) -> str:
    """Return the name of the shipped set in force, or else of the set that could be there."""
    name = settings_name(config.estimator, config.arz_parameters.name, config.privacy.preset)
    return config.settings_name or name


def machine(packages: Sequence[str]) -> dict[str, str]:
    """Return the versions of Python, the platform and packages."""
    versions = {name: version(name) for name in packages}
    return {"python": platform.python_version(), "platform": platform.platform(), **versions}


def source_digest() -> str:
    """Return a digest of the package's code, which changes more often than its version."""
    return package_digest(dptse_env)


def check_folder(folder: Path, provenance: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the provenance of a folder; None where there is nothing yet.

    Raises:
        ValueError: The folder was made with something else, or has no provenance.
    """
    path = folder / PROVENANCE_FILE
    if not path.exists():
        if folder.exists() and any(folder.iterdir()):
            raise ValueError(
                f"{folder} is not empty and has no {PROVENANCE_FILE}: choose another --output"
            )
        return None
    try:
        recorded: dict[str, Any] = json.loads(path.read_bytes())
        made_with = recorded["made_with"]
        parts = made_with["settings"], recorded["tuned"], recorded["sources"]
        if tuple(map(type, parts)) != (dict, list, list):
            raise ValueError("settings must be a mapping, tuned and sources lists")
    except (ValueError, KeyError, TypeError) as problem:
        raise ValueError(f"{path} is not as this program writes it: {problem!r}") from problem
    now = provenance["made_with"]
    differences = list(_differences(made_with, now))
    differences += [f"{key} is missing there" for key in now if key not in made_with]
    differences += [f"{key} is only there" for key in made_with if key not in now]
    if differences:
        raise ValueError(
            f"{folder} was made with other settings: {'; '.join(differences[:5])}. Choose "
            "another --output, or remove the folder to start over"
        )
    return recorded


def take_folder(folder: Path, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Take a folder for new results: start it, or go on in one that was made in the same way.

    Settings of estimators and states of the code that the folder does not have yet are added.

    Returns:
        The provenance of the folder.

    Raises:
        ValueError: The folder was made with something else, or has no provenance.
    """
    recorded = check_folder(folder, provenance)
    content = dict(provenance)
    if recorded is not None:
        made_with = provenance["made_with"]
        settings = {**recorded["made_with"]["settings"], **made_with["settings"]}
        content |= {
            "made_with": {**made_with, "settings": settings},
            "tuned": sorted({*recorded["tuned"], *provenance["tuned"]}),
            "sources": list(dict.fromkeys([*recorded["sources"], *provenance["sources"]])),
        }
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / PROVENANCE_FILE, content)
    return content


def _differences(before: Any, now: Any, path: str = "") -> Iterator[str]:
    """Yield a description of each value that both have and that differs."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in before.keys() & now.keys():
            yield from _differences(before[key], now[key], f"{path}.{key}" if path else key)
    elif before != now:
        yield f"{path} is {before!r} there and {now!r} now"
