"""The configuration of an environment: one frozen dataclass, presets, and how keywords change them.

Everything is reachable from plain JSON, so the keywords of ``gym.make`` survive a spec. A
configuration holds and checks; `dptse_env.parts` makes what it describes.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from dptse_env.estimators import check_estimator, settings_type
from dptse_env.estimators.tuned_settings import (
    available_settings,
    known_settings,
    load_settings,
    settings_name,
)
from dptse_env.model import ARZParameters, available_parameters, load_parameters
from dptse_env.release import RELEASE_MODELS, CappedSettings, PrivacySettings
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.spaces.observations import BLOCKS, DEFAULT
from dptse_env.spaces.rewards import REWARDS
from dptse_env.traffic import CORRIDORS, Corridor, find_corridor, randomised
from dptse_env.utils.fields import Interval, checked_fields, field_hints, from_mapping

TRAINING_SEEDS = range(1_000)
"""Traffic seeds meant for training and calibration."""
VALIDATION_SEEDS = range(1_000, 2_000)
"""Traffic seeds meant for choosing among trained policies."""
TEST_SEEDS = range(2_000, 3_000)
"""Traffic seeds meant for the numbers that are reported."""

MOST_SEEDS = 10_000
"""Traffic seeds of one environment at most."""

TIME_STEP = 1.0
"""Time step of the traffic model and of the environment [s]."""

GEOMETRY = (
    "n_mainline", "on_ramps", "off_ramps", "exit_shares", "lanes", "ramp_lanes", "segment_length",
    "speed_limit",
)  # fmt: skip
"""Fields of a corridor by which it is another road: what was fitted to one may not suit another."""

TrafficSeed = Annotated[int, Interval(0, 2**31 - 1)]
"""A traffic seed, as SUMO takes it."""


def _require_name(path: str, name: object, known: Iterable[str]) -> None:
    known = list(known)
    if not isinstance(name, str) or name not in known:
        raise ValueError(f"{path} must be one of {', '.join(known)}, got {name!r}")


class UnknownKeywordError(TypeError, ValueError):
    """A keyword that an environment does not have.

    A ``TypeError`` as for any function, since libraries that try keywords on environments look for
    it, and a ``ValueError`` as for every other bad keyword.
    """


@dataclass(frozen=True)
class EnvConfig:
    """Everything that an environment is made of.

    Attributes:
        corridor: The road, its demand, incident and fixed sensors.
        estimator: The estimator: ``ekf``, ``ukf``, ``enkf``, ``mhe``, ``random_walk``,
            ``open_loop``, a registered name, ``"package.module:Class"``, or a class.
        backend: ``compiled`` or ``reference``.
        parameters: ARZ parameters, or the name of a set.
        estimator_settings: Tuning of the estimator, or the name of a shipped set
            (`dptse_env.estimators.tuned_settings`), whichever estimator it was tuned for. None for
            the set ``<estimator>-<ARZ parameters>-<privacy preset>`` if one ships, else the
            estimator's defaults.
        bandwidth: Most mainline segments to query a step.
        action: The action encoding: ``mask``, ``scores``, ``slots``, ``sequential``, a registered
            name, ``"package.module:Class"``, or a class.
        observation: Blocks of the observation, in order: names, ``"package.module:Class"``, classes
            or objects; ``"default"`` stands for all default blocks.
        privacy: The release model with its epsilon and delta, and what they protect.
        reward: The reward: ``joint``, ``density``, ``speed``, a registered name,
            ``"package.module:function"``, or a function of a `ScoredSecond`.
        horizon: Length of an episode [s]; None for the whole record.
        random_start: Whether an episode starts at a random second of the record.
        traffic_seeds: Traffic seeds to draw episodes from.
        truth_in_info: Whether ``info`` shows the true traffic.
        inherited: Keywords whose values were measured or tuned on another road than this one, and
            that nobody gave; filled in by `resolve`.

    Raises:
        ValueError: A value is out of range, or the parameters violate the CFL condition.
    """

    corridor: Corridor
    estimator: Any = "ekf"
    backend: str = "compiled"
    parameters: str | ARZParameters = "paper"
    estimator_settings: Any = None
    bandwidth: Annotated[int, Interval(1, 1000)] = 5
    action: Any = "mask"
    observation: tuple[Any, ...] = (DEFAULT,)
    privacy: PrivacySettings = field(default_factory=PrivacySettings)
    reward: Any = "joint"
    horizon: Annotated[int, Interval(1, 100_000)] | None = None
    random_start: bool = False
    traffic_seeds: tuple[TrafficSeed, ...] = tuple(TRAINING_SEEDS[:64])
    truth_in_info: bool = False
    inherited: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        """Check everything that needs no traffic."""
        checked_fields(self, "")
        ACTION_ENCODINGS.find(self.action)
        REWARDS.find(self.reward)
        for block in self.observation:
            if not (isinstance(block, str) and block == DEFAULT):
                BLOCKS.find(block)
        RELEASE_MODELS.find(self.privacy.preset)
        check_estimator(self.estimator, self.backend)
        n, duration = self.corridor.n_mainline, self.corridor.duration
        if self.bandwidth > n:
            raise ValueError(f"bandwidth must be in 1..{n}, got {self.bandwidth}")
        if self.horizon_steps > duration:
            raise ValueError(f"horizon must be in 1..{duration}, got {self.horizon}")
        if self.random_start and self.horizon_steps == duration:
            raise ValueError(
                f"random_start needs a horizon below the record's {duration} s, got {self.horizon}"
            )
        seeds = self.traffic_seeds
        if not 1 <= len(seeds) <= MOST_SEEDS:
            raise ValueError(f"traffic_seeds must be 1 to {MOST_SEEDS} seeds, got {len(seeds)}")
        if len(set(seeds)) < len(seeds):
            raise ValueError(f"traffic_seeds must be distinct, got {seeds}")
        if isinstance(self.parameters, str):
            _require_name("parameters", self.parameters, available_parameters())
        self.arz_parameters.require_time_step(TIME_STEP, self.corridor.segment_length)
        self._check_settings()

    def _check_settings(self) -> None:
        settings, expected = self.estimator_settings, settings_type(self.estimator)
        if isinstance(settings, str):
            known_settings(settings)
        elif settings is not None and not isinstance(settings, expected):
            raise ValueError(
                f"estimator_settings must be a mapping, the name of a set, or a "
                f"{expected.__name__}, got {settings!r}"
            )

    @property
    def horizon_steps(self) -> int:
        """Length of an episode [s]."""
        return self.corridor.duration if self.horizon is None else self.horizon

    @property
    def last_start(self) -> int:
        """Latest second of the record at which an episode may start."""
        return self.corridor.duration - self.horizon_steps

    @property
    def arz_parameters(self) -> ARZParameters:
        """The ARZ parameters of the estimator's model."""
        parameters = self.parameters
        return load_parameters(parameters) if isinstance(parameters, str) else parameters

    @property
    def settings_name(self) -> str | None:
        """Name of the shipped set of estimator settings in force; None if there is none."""
        given = self.estimator_settings
        if given is not None:
            return given if isinstance(given, str) else None
        if not isinstance(self.estimator, str) or not isinstance(self.privacy.preset, str):
            return None
        name = settings_name(self.estimator, self.arz_parameters.name, self.privacy.preset)
        return name if name in available_settings() else None

    def settings(self) -> Any:
        """Return the estimator's settings in force, of its settings' type."""
        name = self.settings_name
        if name is not None:
            return load_settings(name)
        given = self.estimator_settings
        return settings_type(self.estimator)() if given is None else given


PRESETS = {
    "paper-highway": EnvConfig(corridor=CORRIDORS["paper-highway"]),
    "private-highway": EnvConfig(
        corridor=randomised(CORRIDORS["paper-highway"]),
        parameters="w99-3lane",
        privacy=CappedSettings(epsilon=5.0, cap=64),
    ),
    "short-highway": EnvConfig(corridor=CORRIDORS["short-highway"], bandwidth=2),
}
"""Configurations by name."""


def resolve(preset: str, overrides: Mapping[str, Any]) -> EnvConfig:
    """Return a preset with some of its fields replaced.

    Args:
        preset: A name in `PRESETS`.
        overrides: Fields of `EnvConfig`. A mapping replaces the named fields of a nested
            dataclass and keeps the others. Names stand for known values: a corridor, a release
            model. Shortcuts: ``epsilon`` and ``delta`` of ``privacy``, ``incident`` of
            ``corridor`` (``"preset"``, ``"none"``, ``"random"`` or a mapping) and ``demand`` of
            ``corridor`` (the same without ``"none"``); random means drawn anew for every traffic
            seed. ``traffic_seeds`` may be a string ``"first:stop"``. In a mapping
            ``estimator_settings``, fields left out keep what None would have given: the tuned set
            of the resolved estimator, parameters and privacy preset, or else the defaults.

    Raises:
        UnknownKeywordError: A key is no field and no shortcut.
        ValueError: A value is out of range; the message starts with its path.

    Warns:
        UserWarning: The corridor is another road, and values measured or tuned on the preset's
            road are used on it.
    """
    _require_name("preset", preset, PRESETS)
    base, values = PRESETS[preset], dict(overrides)
    _check_keywords(values)
    corridor = _corridor(base.corridor, values)
    values["privacy"] = _privacy(base.privacy, values)
    if isinstance(values.get("traffic_seeds"), str):
        values["traffic_seeds"] = parse_seeds(values["traffic_seeds"], "traffic_seeds")
    if isinstance(values.get("observation"), str):
        values["observation"] = (values["observation"],)
    settings = values.get("estimator_settings")
    if isinstance(settings, Mapping):
        del values["estimator_settings"]
    config = from_mapping(EnvConfig, {**values, "corridor": corridor}, "", base)
    if isinstance(settings, Mapping):
        expected = settings_type(config.estimator)
        given = from_mapping(expected, settings, "estimator_settings", config.settings())
        config = replace(config, estimator_settings=given)
    inherited = _inherited(corridor, config, overrides)
    if inherited and not config.inherited:
        config = replace(config, inherited=inherited)
        warnings.warn(
            f"{', '.join(inherited)}: values measured or tuned on {base.corridor.name} are used on "
            "another road; give them to use others",
            UserWarning,
            stacklevel=3,
        )
    return config


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
            _require_name(key, value, names)
            source = randomised(base) if value == "random" else base
            value = None if value == "none" else getattr(source, key)
        base = from_mapping(Corridor, {key: value}, "corridor", base)
    return base


def _with_scales(base: Corridor, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields of a corridor with scales that follow a change of lanes and speed limit."""
    whole = dict(fields)
    for scale, cause in (("density_scale", "lanes"), ("speed_scale", "speed_limit")):
        changed = whole.get(cause)
        if (
            scale not in whole
            and isinstance(changed, int | float)
            and not isinstance(changed, bool)
        ):
            whole[scale] = getattr(base, scale) * float(changed) / getattr(base, cause)
    return whole


def _inherited(
    corridor: Corridor, config: EnvConfig, overrides: Mapping[str, Any]
) -> tuple[str, ...]:
    """Return the keywords that another road left as they are for the preset's."""
    geometry = [getattr(corridor, name) for name in GEOMETRY]
    shipped = [preset.corridor for preset in PRESETS.values()]
    if any(geometry == [getattr(road, name) for name in GEOMETRY] for road in shipped):
        return ()
    found = []
    given = overrides.get("corridor")
    if isinstance(given, Mapping) and "average_dwell" not in given:
        found.append("corridor.average_dwell")
    if isinstance(config.parameters, str) and "parameters" not in overrides:
        found.append("parameters")
    if config.settings_name is not None and "estimator_settings" not in overrides:
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
