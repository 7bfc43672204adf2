"""What a folder of results was made with; another make is refused."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dptse_env
from agents.evaluation.episodes import WARM_UP
from agents.experiments.ledger import Cell, CellT
from agents.experiments.runner import Design, make_env
from dptse_env.config import EnvConfig
from dptse_env.estimators.tuning import available_settings, settings_name
from dptse_env.model import load_parameters

FILE = "run.json"


def provenance(design: Design[CellT]) -> dict[str, Any]:
    """Return everything beside the cells and seeds that the results depend on, as plain JSON.

    ``made_with`` must agree for results to stand in one folder. ``tuned`` names the settings that
    come from a shipped set. ``sources`` (states of the package's code) and ``machine`` are for the
    record.

    Raises:
        ValueError: A cell of the design is out of range; the message names the value.
    """
    configs = [_config(design, cell) for cell in design.cells()]
    made_with: dict[str, Any] = {
        "versions": {name: version(name) for name in ("dptse-env", "libsumo")},
        "env": design.env,
        "corridor": configs[0].corridor.digest,
        "schedule": design.schedule,
        "warm_up": WARM_UP,
        "parameters": {
            name: dataclasses.asdict(load_parameters(name))
            for name in dict.fromkeys(str(config.parameters) for config in configs)
        },
        "settings": {
            _settings_name(config): dataclasses.asdict(config.settings()) for config in configs
        },
    }
    machine = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{name: version(name) for name in ("gymnasium", "numba", "numpy", "scipy")},
    }
    tuned = sorted(made_with["settings"].keys() & available_settings())
    whole = {
        "made_with": made_with,
        "tuned": tuned,
        "sources": [source_digest()],
        "machine": machine,
    }
    plain: dict[str, Any] = json.loads(json.dumps(whole))
    return plain


def source_digest() -> str:
    """Return a digest of the package's code, which changes more often than its version."""
    digest = hashlib.sha256()
    root = Path(dptse_env.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def _config(design: Design[Any], cell: Cell) -> EnvConfig:
    env = make_env(design.env, cell, design.seeds, None)
    config: EnvConfig = env.unwrapped.config  # type: ignore[attr-defined]
    return config


def _settings_name(config: EnvConfig) -> str:
    return settings_name(config.estimator, str(config.parameters), config.privacy.preset)


def take_folder(folder: Path, own: Mapping[str, Any]) -> dict[str, Any]:
    """Take a folder for a run: start it, or go on in one that was made in the same way.

    Settings of estimators and states of the code that the folder has not seen yet are added.

    Returns:
        What the folder now says it was made with.

    Raises:
        ValueError: The folder was made with something else, or without saying with what.
    """
    path = folder / FILE
    if path.exists():
        try:
            whole = json.loads(path.read_text(encoding="utf-8"))
            before, sources = whole["made_with"], whole["sources"]
        except (json.JSONDecodeError, KeyError) as problem:
            raise ValueError(f"{path} is not as this program writes it: {problem!r}") from problem
        differences = list(_differences(before, own["made_with"]))
        if differences:
            raise ValueError(
                f"{folder} was made with other settings: {'; '.join(differences[:5])}. Choose "
                "another --output, or remove the folder to start over"
            )
        settings = {**before["settings"], **own["made_with"]["settings"]}
        own = {
            **own,
            "made_with": {**own["made_with"], "settings": settings},
            "tuned": sorted({*whole["tuned"], *own["tuned"]}),
            "sources": list(dict.fromkeys([*sources, *own["sources"]])),
        }
    elif folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty and has no {FILE}: choose another --output")
    folder.mkdir(parents=True, exist_ok=True)
    aside = path.with_suffix(".tmp")
    aside.write_text(json.dumps(own, indent=2) + "\n", encoding="utf-8")
    aside.replace(path)
    return dict(own)


def _differences(before: Any, now: Any, path: str = "") -> Iterator[str]:
    """Name each value that both have and that differs."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in before.keys() & now.keys():
            yield from _differences(before[key], now[key], f"{path}.{key}" if path else key)
    elif before != now:
        yield f"{path} is {before!r} there and {now!r} now"
