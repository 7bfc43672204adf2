"""Keywords of an environment: how they change the configuration of a preset."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dptse_env.config.env_config import MOST_SEEDS, PRESETS, TRAINING_SEEDS, EnvConfig
from dptse_env.estimators import ESTIMATORS, settings_type
from dptse_env.estimators.settings import read_settings, tuned_estimator, tuned_with
from dptse_env.model.parameters import read_parameters
from dptse_env.release import RELEASE_MODELS, PrivacySettings
from dptse_env.traffic import (
    Corridor,
    Penetration,
    RoadFile,
    find_corridor,
    is_road_file,
    randomised,
    read_road,
)
from dptse_env.utils.fields import field_hints, from_mapping
from dptse_env.utils.validation import require_name

GEOMETRY = (
    "n_mainline", "on_ramps", "off_ramps", "exit_shares", "lanes", "ramp_lanes", "segment_length",
    "speed_limit", "ramp_segments", "ramp_length", "ramp_speed_limit",
)  # fmt: skip
"""Fields of a corridor by which it is another road: what was fitted to one may not suit another."""


class UnknownKeywordError(TypeError, ValueError):
    """A keyword that an environment does not have.

    A ``TypeError`` as for any function, since libraries that try keywords on environments look for
    it, and a ``ValueError`` as for every other bad keyword.
    """


def resolve(preset: str, overrides: Mapping[str, Any]) -> EnvConfig:
    """Return a preset with some of its fields replaced.

    Args:
        preset: A name in `PRESETS`.
        overrides: Fields of `EnvConfig`. A mapping replaces the named fields of a nested
            dataclass and keeps the others. Names stand for known values: a corridor, a release
            model. A corridor that ends in ``.toml`` is a road file, whose table ``environment``
            gives keywords that are not among ``overrides``, but for settings in a file that were
            tuned for another estimator; ``parameters`` and ``estimator_settings`` may be JSON
            files. Shortcuts: ``epsilon`` and ``delta``
            of ``privacy``, ``incident`` of ``corridor`` (``"preset"``, ``"none"``, ``"random"`` or
            a mapping) and ``demand`` of ``corridor`` (the same without ``"none"``); random means
            drawn anew for every traffic seed. ``traffic_seeds`` may be a string ``"first:stop"``;
            on a road with recordings they are by default all recorded training seeds.
            In a mapping ``estimator_settings``, fields left out keep what None would have given:
            the tuned set of the resolved estimator, parameters and privacy preset, or else the
            defaults.

    Raises:
        UnknownKeywordError: A key is no field and no shortcut.
        ValueError: A value is out of range; the message starts with its path.

    Warns:
        UserWarning: The corridor is another road, or the ARZ parameters are of one's own, and
            values that were measured or tuned for others, or assumed, are used.
    """
    require_name("preset", preset, PRESETS)
    road = _road_file(overrides)
    base, values = PRESETS[preset], {**road.environment, **overrides} if road else dict(overrides)
    _check_keywords(values)
    _read_files(values)
    if road and _is_tuned_for_another(road, overrides, values.get("estimator", base.estimator)):
        del values["estimator_settings"]
    overrides = dict(values)
    if road:
        values["corridor"] = road.corridor
    corridor = _corridor(base.corridor, values)
    values["privacy"] = _privacy(base.privacy, values)
    if "penetration" in values and not isinstance(values["penetration"], Mapping | Penetration):
        values["penetration"] = {"share": values["penetration"]}
    _read_seeds(values, corridor)
    if isinstance(values.get("observation"), str):
        values["observation"] = (values["observation"],)
    config = _config(base, values, corridor)
    inherited = _inherited(corridor, config, overrides, road.assumed if road else ())
    if inherited and not config.inherited:
        config = replace(config, inherited=inherited)
        warnings.warn(
            f"{', '.join(inherited)}: values measured or tuned on {base.corridor.name}, or "
            "assumed, are used on another road or with other parameters; give them to use others",
            UserWarning,
            stacklevel=3,
        )
    return config


def _config(base: EnvConfig, values: dict[str, Any], corridor: Corridor) -> EnvConfig:
    """Return the configuration; a mapping of settings changes those that are otherwise in force."""
    settings = values.get("estimator_settings")
    if not isinstance(settings, Mapping):
        return from_mapping(EnvConfig, {**values, "corridor": corridor}, "", base)
    del values["estimator_settings"]
    config = from_mapping(EnvConfig, {**values, "corridor": corridor}, "", base)
    expected = settings_type(config.estimator)
    given = from_mapping(expected, settings, "estimator_settings", config.settings())
    return replace(config, estimator_settings=given)


def _read_seeds(values: dict[str, Any], corridor: Corridor) -> None:
    """Replace a range of traffic seeds by these, and put recorded ones where none are given."""
    if "traffic_seeds" not in values and corridor.recordings is not None:
        recorded = corridor.recordings.seeds
        values["traffic_seeds"] = tuple(seed for seed in recorded if seed in TRAINING_SEEDS)
    if isinstance(values.get("traffic_seeds"), str):
        values["traffic_seeds"] = parse_seeds(values["traffic_seeds"], "traffic_seeds")


def _road_file(overrides: Mapping[str, Any]) -> RoadFile | None:
    """Return the road file that the keyword ``corridor`` names; None for another corridor."""
    corridor = overrides.get("corridor")
    return read_road(corridor) if is_road_file(corridor) else None


def _read_files(values: dict[str, Any]) -> None:
    """Replace names of JSON files of parameters and estimator settings by their content.

    Raises:
        ValueError: A file cannot be read, or has another format.
    """
    readers = {"parameters": read_parameters, "estimator_settings": read_settings}
    for key, read in readers.items():
        value = values.get(key)
        if isinstance(value, str) and value.endswith(".json"):
            try:
                values[key] = read(value)
            except OSError as problem:
                raise ValueError(f"{key}: {value} cannot be read: {problem.strerror}") from problem


def _is_tuned_for_another(road: RoadFile, overrides: Mapping[str, Any], estimator: Any) -> bool:
    """Return whether settings come from a road's table and were tuned for another estimator."""
    settings = road.environment.get("estimator_settings")
    if "estimator_settings" in overrides or not str(settings).endswith(".json"):
        return False
    return tuned_estimator(str(settings)) != ESTIMATORS.name_of(estimator)


def parse_seeds(text: str, path: str = "seeds") -> tuple[int, ...]:
    """Return the seeds that ``"first:stop"`` or ``"one"`` stands for, ``stop`` left out.

    Raises:
        ValueError: The text is neither, or the range is empty or too long.
    """
    first, colon, stop = text.partition(":")
    if not (first.isdecimal() and (stop.isdecimal() or not colon)) or len(text) > 40:
        raise ValueError(f"{path} must be 'first:stop' or one seed, got {text[:60]!r}")
    seeds = range(int(first), int(stop) if colon else int(first) + 1)
    if not seeds:
        raise ValueError(f"{path} must not be empty, got {text!r}")
    if seeds.stop - seeds.start > MOST_SEEDS:
        raise ValueError(f"{path} must be at most {MOST_SEEDS} seeds, got {text!r}")
    return tuple(seeds)


_SHORTCUTS = ("epsilon", "delta", "incident", "demand")


def _check_keywords(values: Mapping[str, Any]) -> None:
    known = (*field_hints(EnvConfig), *_SHORTCUTS)
    for key in values:
        if key not in known:
            raise UnknownKeywordError(
                f"{key} is unknown; allowed: {', '.join(known)} (got an unexpected keyword "
                f"argument {key!r})"
            )


def _corridor(base: Corridor, values: dict[str, Any]) -> Corridor:
    """Take the keywords about the corridor out of ``values`` and apply them."""
    corridor = values.pop("corridor", {})
    if isinstance(corridor, Mapping):
        base = from_mapping(Corridor, _with_scales(base, corridor), "corridor", base)
    else:
        base = find_corridor(corridor)
    for key, names in (
        ("demand", ("preset", "random")),
        ("incident", ("preset", "random", "none")),
    ):
        if key not in values:
            continue
        value = values.pop(key)
        if isinstance(value, str):
            require_name(key, value, names)
            source = randomised(base) if value == "random" else base
            value = None if value == "none" else getattr(source, key)
        base = from_mapping(Corridor, {key: value}, "corridor", base)
    return base


def _with_scales(base: Corridor, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields of a corridor with scales that follow a change of lanes and speed limit."""
    scales = {"density_scale": "lanes", "speed_scale": "speed_limit"}
    changed = {scale for scale, cause in scales.items() if cause in fields and scale not in fields}
    if not changed:
        return dict(fields)
    road = from_mapping(Corridor, fields, "corridor", base)
    factors = {
        "density_scale": road.most_lanes / base.most_lanes,
        "speed_scale": road.largest_speed_limit / base.largest_speed_limit,
    }
    return {**fields, **{scale: getattr(base, scale) * factors[scale] for scale in changed}}


def _inherited(
    corridor: Corridor, config: EnvConfig, overrides: Mapping[str, Any], assumed: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the keywords whose values are of another road or parameter set, or assumed."""
    geometry = [getattr(corridor, name) for name in GEOMETRY]
    shipped = [preset.corridor for preset in PRESETS.values()]
    is_other_road = all(geometry != [getattr(road, name) for name in GEOMETRY] for road in shipped)
    found = []
    if is_other_road:
        found = [f"corridor.{name}" for name in assumed]
        given = overrides.get("corridor")
        if isinstance(given, Mapping) and "average_dwell" not in given:
            found.append("corridor.average_dwell")
        if isinstance(config.parameters, str) and "parameters" not in overrides:
            found.append("parameters")
    parameters = config.arz_parameters
    is_other = is_other_road or tuned_with(parameters) != parameters.name
    if is_other and config.settings_name is not None and "estimator_settings" not in overrides:
        found.append("estimator_settings")
    return tuple(found)


def _privacy(base: PrivacySettings, values: dict[str, Any]) -> PrivacySettings:
    """Take the keywords about privacy out of ``values`` and apply them.

    A change of the release model keeps epsilon and delta and takes the model's defaults otherwise.
    """
    given = values.pop("privacy", {})
    if isinstance(given, PrivacySettings):
        base, given = given, {}
    elif isinstance(given, str | type):
        given = {"preset": given}
    elif not isinstance(given, Mapping):
        raise ValueError(
            f"privacy must be the name of a release model, a class or a mapping, got {given!r}"
        )
    given = dict(given)
    preset = given.pop("preset", base.preset)
    if not isinstance(preset, str | type):
        raise ValueError(f"privacy.preset must be a name or a class, got {preset!r}")
    if isinstance(preset, str):
        preset = RELEASE_MODELS.name_of(preset)
    if preset != base.preset:
        model = RELEASE_MODELS.find(preset)
        base = model.settings_type(preset=preset, epsilon=base.epsilon, delta=base.delta)
    given |= {key: values.pop(key) for key in ("epsilon", "delta") if key in values}
    return from_mapping(type(base), given, "privacy", base)
