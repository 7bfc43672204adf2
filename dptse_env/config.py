"""The configuration of an environment: a dataclass, the table of its keywords, and presets.

Everything is reachable from plain JSON, so the keywords of ``gym.make`` survive a spec. A
configuration holds and checks; `dptse_env.parts` makes what it describes.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Annotated, Any, NamedTuple

from dptse_env.estimators import (
    ESTIMATORS,
    Estimator,
    Played,
    check_estimator,
    checked_settings,
)
from dptse_env.estimators.tuned import (
    PUBLISHED,
    is_of_another_road,
    is_tuned,
    published_settings,
    read_settings,
    tuned_estimator,
    tuned_settings,
    tuned_with,
)
from dptse_env.measurement import FusionSettings, SensorSettings
from dptse_env.model import ARZParameters, load_parameters
from dptse_env.model.parameters import read_parameters
from dptse_env.release import (
    RELEASE_MODELS,
    BandwidthUnit,
    PacedSettings,
    PrivacySettings,
    Queries,
)
from dptse_env.release.queries import check_spans
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.spaces.observations import BLOCKS, DEFAULT
from dptse_env.spaces.rewards import REWARDS
from dptse_env.traffic import (
    CORRIDORS,
    Corridor,
    Penetration,
    is_road_file,
    randomised,
    read_road,
)
from dptse_env.traffic.imported import has_vehicles, recorded_seeds, require_seeds
from dptse_env.utils.registry import Registry
from dptse_env.utils.validation import (
    Interval,
    convert,
    cut,
    field_hints,
    from_mapping,
    require,
    require_name,
    shown,
    within,
)

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

TrafficSeed = Annotated[int, Interval(0, 2**31 - 1)]
"""A traffic seed, as SUMO takes it."""


@dataclass(frozen=True, init=False)
class EnvConfig:
    """Everything that an environment is made of, read of its keywords.

    Attributes:
        corridor: The road, its demand, incident and fixed sensors.
        estimator: The estimator: ``ekf``, ``ukf``, ``enkf``, ``mhe``, ``random_walk``,
            ``blend``, ``open_loop``, ``recurrent``, ``asm``, a registered name,
            ``"package.module:Class"``, or a class.
        backend: ``compiled``, or ``reference``, which EKF, UKF, EnKF and MHE have.
        parameters: ARZ parameters; a name stands for a shipped set.
        estimator_settings: Tuning of the estimator, or the name of a shipped set
            (`dptse_env.estimators.tuned`), whichever estimator it was tuned for; ``published`` for
            EKF, UKF, EnKF and MHE as the paper has them, which ``PaperHighway-v0`` has. None for
            the set ``<estimator>-<ARZ parameters>-<privacy preset>-<corridor>``, or that without
            the corridor's name, if one ships, else the estimator's defaults. Parameters of one's
            own take those of the shipped ones that they were derived from.
        bandwidth: Largest total cost of the queries of a step, in ``bandwidth_unit``; by default a
            number of mainline segments, at most those that there are.
        query_spans: Numbers of neighbouring mainline segments that one query may cover, ascending.
            Several segments are released as one sum. Others than 1 need a release model that
            releases sums.
        bandwidth_unit: Cost of a query: ``segments``, the number of segments that it covers, or
            ``sums``, one.
        query_every: Seconds of a step: one with queries, then seconds without.
        action: The action encoding: ``mask``, ``scores``, ``slots``, ``sequential``, a registered
            name, ``"package.module:Class"``, or a class.
        observation: Blocks of the observation, in order: names, ``"package.module:Class"``, classes
            or objects; ``"default"`` stands for all default blocks.
        privacy: The release model with its epsilon, delta and unit of protection.
        penetration: The vehicles that are connected and answer queries; a number is their share.
        sensor_settings: Errors of the fixed sensors, and their part of the privacy budget.
        fusion: Settings by which answers of connected vehicles and fixed sensors become
            measurements.
        reward: The reward: ``joint``, ``density``, ``speed``, a registered name,
            ``"package.module:function"``, or a function of a `ScoredSecond`.
        horizon: Length of an episode [s]; None for the whole record.
        random_start: Whether an episode starts at a random second of the record.
        traffic_seeds: Traffic seeds to draw episodes from, as a list or ``"first:stop"``; on a road
            with recordings by default all training seeds that were recorded.
        truth_in_info: Whether ``info`` shows the true traffic.
        inherited: Keywords whose values were measured or tuned on another road than this one, or
            with other ARZ parameters, or are defaults that nobody tuned, and that nobody gave; as
            `resolve` finds them.
        origins: Text in front of messages on keywords that a road file gave, by keyword.
    """

    corridor: Corridor = CORRIDORS["paper-highway"]
    estimator: Any = "ekf"
    backend: str = "compiled"
    parameters: ARZParameters = field(default=load_parameters("published"))
    estimator_settings: Any = None
    bandwidth: Annotated[int, Interval(1, 1000)] = 5
    query_spans: tuple[Annotated[int, Interval(1, 1000)], ...] = (1,)
    bandwidth_unit: BandwidthUnit = "segments"
    query_every: Annotated[int, Interval(1, 3600)] = 1
    action: Any = "mask"
    observation: tuple[Any, ...] = (DEFAULT,)
    privacy: PrivacySettings = field(default=PrivacySettings())
    penetration: Penetration = field(default=Penetration())
    sensor_settings: SensorSettings = field(default=SensorSettings())
    fusion: FusionSettings = field(default=FusionSettings())
    reward: Any = "joint"
    horizon: Annotated[int, Interval(1, 100_000)] | None = None
    random_start: bool = False
    traffic_seeds: tuple[TrafficSeed, ...] = tuple(TRAINING_SEEDS[:64])
    truth_in_info: bool = False
    inherited: tuple[str, ...] = field(default=(), compare=False)
    origins: Mapping[str, str] = field(default_factory=dict, compare=False, repr=False)

    def __init__(
        self,
        base: EnvConfig | None = None,
        *,
        inherited: tuple[str, ...] = (),
        origins: Mapping[str, str] | None = None,
        **values: Any,
    ) -> None:
        """Read keywords in the order of `KEYWORDS`, each with those that it needs.

        Args:
            base: A configuration that the keywords change; None for the defaults.
            inherited: See the attribute.
            origins: See the attribute.
            **values: Values of `KEYWORDS` and `SHORTCUTS`, which may be plain JSON.

        Raises:
            UnknownKeywordError: There is no such keyword.
            ValueError: A value is out of range; the message starts with its origin and path.
        """
        places = origins or {}
        fields: dict[str, Any] = {"inherited": inherited, "origins": places}
        _require_known(values, places)
        for name, keyword in KEYWORDS.items():
            value, needs = getattr(base or EnvConfig, name), [fields[n] for n in keyword.needs]
            if name not in values and keyword.default is not None:
                value = keyword.default(value, *needs)
            given = {name: values.get(name, value)}
            given |= {key: {key: values[key]} for key in values if SHORTCUTS.get(key) == name}
            for key, each in given.items():
                with within(places.get(key, "")):
                    value = keyword.read(name, each, value, *needs)
            fields[name] = value
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @property
    def has_separate_sensors(self) -> bool:
        """True if fixed sensors measure other things than queries do."""
        return not self.penetration.is_complete or self.sensor_settings != SensorSettings()

    @cached_property
    def queries(self) -> Queries:
        """The queries among which a policy chooses."""
        return Queries.make(
            self.corridor.geometry.n_mainline,
            self.bandwidth,
            self.query_spans,
            self.bandwidth_unit,
            self.has_separate_sensors,
        )

    @property
    def horizon_steps(self) -> int:
        """Length of an episode [s]."""
        return self.corridor.conditions.duration if self.horizon is None else self.horizon

    @property
    def last_start(self) -> int:
        """Latest second of the record at which an episode may start."""
        return self.corridor.conditions.duration - self.horizon_steps

    @property
    def release_model(self) -> Any:
        """The class of the release model."""
        return RELEASE_MODELS.find(self.privacy.preset)

    @property
    def settings_name(self) -> str | None:
        """Name of the shipped set of estimator settings in force; None if there is none."""
        given, parameters = self.estimator_settings, self.parameters
        return _shipped(given, self.estimator, parameters, self.privacy, self.corridor)

    @property
    def releases_flow(self) -> bool:
        """True where centred flows are released, False where mean speeds are."""
        return self.release_model.centre(self.corridor, self.privacy) is not None

    def settings(self) -> Any:
        """Return the estimator's settings in force, of its settings' type.

        Raises:
            ValueError: They are no settings of this estimator.
        """
        given = checked_settings(self.estimator, self.settings_name or self.estimator_settings)
        estimator: type[Estimator] = ESTIMATORS.find(self.estimator)
        return estimator.in_force(self.corridor.road, _played(self), given)

    def made_for(self) -> Mapping[str, str]:
        """Return settings that were made for other roads, traffic or releases, and for which."""
        estimator: type[Estimator] = ESTIMATORS.find(self.estimator)
        with within(self.origins.get("estimator_settings", "")):
            return estimator.inherits(self.corridor.road, _played(self), self.settings())


# Readers ------------------------------------------------------------------------------------------
#
# Each takes the path of a value, the value, the preset's value and the keywords that it needs, and
# returns the field. A value that was read already it checks and returns as it is.


def _typed(path: str, value: Any, base: Any) -> Any:
    """Return a value as the annotation of its field has it; mappings change the preset's value."""
    return convert(field_hints(EnvConfig)[path], value, path, base)


def _part(registry: Registry, _path: str, value: Any, _base: Any) -> Any:
    """Return the name of a part, ``"package.module:Name"``, or a part, if there is such a one."""
    registry.find(value)
    return value


def _corridor(path: str, value: Any, base: Corridor) -> Corridor:
    """Return a corridor: by name, an object, or fields that replace those of the preset's."""
    if isinstance(value, Mapping):
        corridor = _changed(path, value, base)
    else:
        if isinstance(value, str | os.PathLike) and value not in CORRIDORS:
            # Unlike `Path`, this takes names that are too long for a file.
            is_import = os.path.isfile(f"{os.fspath(value)}/road.toml")  # noqa: PTH113
            require(not is_import, path, "a road file, such as road.toml in this folder", value)
        found = CORRIDORS.find(value)
        corridor = found() if callable(found) else found
        require(isinstance(corridor, Corridor), path, "a Corridor, or what returns one", corridor)
    passed = "None on a road of measured fields, which say of nobody that he passes"
    countable = corridor.loops is None or has_vehicles(corridor.recordings)
    require(countable, f"{path}.loops", passed, corridor.loops)
    return corridor


def _changed(path: str, value: Mapping[str, Any], base: Corridor) -> Corridor:
    """Return a corridor with other fields.

    Demand and incident may be ``"preset"``, for the road's own, or ``"random"``, drawn anew for
    every traffic seed; an incident also ``"none"``.
    """
    names = {"demand": ("preset", "random"), "incident": ("preset", "random", "none")}
    named = {key: value[key] for key in names if isinstance(value.get(key), str)}
    fields = {key: each for key, each in value.items() if key not in named}
    corridor = Corridor.from_fields(fields, base)
    for key, name in named.items():
        require_name(f"{path}.{key}", name, names[key])
        source = randomised(corridor) if name == "random" else corridor
        given = None if name == "none" else getattr(source.conditions, key)
        corridor = corridor.replaced(**{key: given})
    return corridor


def _privacy(path: str, value: Any, base: PrivacySettings, corridor: Corridor) -> Any:
    """Return settings of a release model: its name or class, an object, or some of its fields.

    Another release model keeps epsilon and delta, and has its own defaults otherwise.
    """
    if not isinstance(value, PrivacySettings):
        given = {"preset": value} if isinstance(value, str | type) else value
        allowed = "the name of a release model, a class or a mapping"
        require(isinstance(given, Mapping), path, allowed, value)
        preset = given.get("preset", base.preset)
        require(isinstance(preset, str | type), f"{path}.preset", "a name or a class", preset)
        if preset != base.preset:
            expected = RELEASE_MODELS.find(preset).settings_type
            base = expected(preset=preset, epsilon=base.epsilon, delta=base.delta)
        value = from_mapping(type(base), {**given, "preset": preset}, path, base)
    model = RELEASE_MODELS.find(value.preset)
    blind = "one that needs no vehicles, as 'printed', on a road of measured fields"
    is_served = has_vehicles(corridor.recordings) or not model.needs_vehicles
    require(is_served, f"{path}.preset", blind, RELEASE_MODELS.name_of(value.preset))
    own = f"'seeded' {_with_model(value)}, whose noise is its own"
    require(value.noise == "seeded" or model.takes_noise, f"{path}.noise", own, value.noise)
    return value


def _with_model(privacy: PrivacySettings) -> str:
    return f"with the release model {RELEASE_MODELS.name_of(privacy.preset)!r}"


def _penetration(
    path: str, value: Any, base: Penetration, corridor: Corridor, privacy: PrivacySettings
) -> Penetration:
    """Return the connected vehicles; a number, or a pair of numbers, is their share."""
    fields = value if isinstance(value, Mapping | Penetration) else {"share": value}
    found: Penetration = _typed(path, fields, base)
    whole = found.is_complete or has_vehicles(corridor.recordings)
    require(whole, f"{path}.share", "1 on a road of measured fields", found.share)
    alike = f"1 {_with_model(privacy)}, which knows of no groups of channels"
    is_served = found.is_complete or RELEASE_MODELS.find(privacy.preset).knows_groups
    require(is_served, f"{path}.share", alike, found.share)
    return found


def _sensor_settings(
    path: str, value: Any, base: SensorSettings, corridor: Corridor, privacy: PrivacySettings
) -> SensorSettings:
    """Return the errors of the fixed sensors, which there must be."""
    found: SensorSettings = _typed(path, value, base)
    n, factor = len(corridor.fixed_sensors), found.factor
    each = f"one number, or one for each of the {n} fixed sensors"
    require(not isinstance(factor, tuple) or len(factor) == n, f"{path}.factor", each, factor)
    exact = "left out on a road without fixed sensors, and on one of measured fields"
    has_any = n > 0 and has_vehicles(corridor.recordings)
    require(has_any or found == SensorSettings(), path, exact, found)
    alike = f"left out {_with_model(privacy)}, which knows of no groups of channels"
    is_served = found == SensorSettings() or RELEASE_MODELS.find(privacy.preset).knows_groups
    require(is_served, path, alike, found)
    return found


def _estimator(path: str, value: Any, base: Any, corridor: Corridor) -> Any:
    """Return the estimator, which readings of loops take back in time."""
    part = _part(ESTIMATORS, path, value, base)
    goes_back = "one that has _memory, to go back in time on a road with loops"
    require(corridor.loops is None or ESTIMATORS.find(part).goes_back(), path, goes_back, part)
    return part


def _backend(path: str, value: Any, base: Any, estimator: Any, corridor: Corridor) -> str:
    """Return the backend, which the estimator must have, and which loops must leave."""
    check_estimator(estimator, value)
    goes_back = "'compiled' on a road with loops, since no reference goes back in time"
    require(corridor.loops is None or value == "compiled", path, goes_back, value)
    return str(_typed(path, value, base))


def _parameters(path: str, value: Any, _base: Any) -> ARZParameters:
    """Return ARZ parameters: by name, an object, a mapping of all of them, or a JSON file."""
    if not isinstance(value, str):
        return from_mapping(ARZParameters, value, path)
    if not value.endswith(".json"):
        return load_parameters(value)
    with within(f"{path}: "):
        return read_parameters(value)


def _shipped(
    value: Any,
    estimator: Any,
    parameters: ARZParameters,
    privacy: PrivacySettings,
    corridor: Corridor,
) -> str | None:
    """Return the name of the shipped settings that a value stands for, as None does, if any."""
    if value is None:
        # A road of one's own takes no variant that happens to have its name.
        road = corridor.name if corridor.name in CORRIDORS else ""
        return tuned_settings(estimator, parameters, privacy.preset, road)
    if isinstance(value, str) and value == PUBLISHED:
        return published_settings(estimator, parameters, privacy.preset)
    return value if isinstance(value, str) else None


def _settings(
    path: str, value: Any, _base: Any, estimator: Any, parameters: Any, privacy: Any, corridor: Any
) -> Any:
    """Return settings of the estimator: a name, an object, a JSON file, or some of its fields.

    Fields left out keep what None stands for: those of the tuned set, or else the defaults.
    """
    shipped = partial(
        _shipped, estimator=estimator, parameters=parameters, privacy=privacy, corridor=corridor
    )
    if isinstance(value, Mapping):
        base = checked_settings(estimator, shipped(None))
        value = from_mapping(ESTIMATORS.find(estimator).settings_type, value, path, base)
    elif isinstance(value, str) and value.endswith(".json"):
        with within(f"{path}: "):
            value = read_settings(value)
    checked_settings(estimator, shipped(value) or value)
    return value


def _settings_of_paper(
    base: Any, estimator: Any, parameters: ARZParameters, privacy: PrivacySettings, road: Corridor
) -> Any:
    """Return the preset's settings; None where they are the paper's, but another part is not."""
    if base != PUBLISHED:
        return base
    name = tuned_settings(estimator, parameters, privacy.preset, PUBLISHED)
    has_filter = name is not None and name.endswith(f"-{PUBLISHED}")
    is_road = road.geometry == CORRIDORS["paper-highway"].geometry
    return base if has_filter and is_road and parameters.name == PUBLISHED else None


def _spans(
    path: str, value: Any, base: Any, corridor: Corridor, privacy: PrivacySettings
) -> tuple[int, ...]:
    """Return numbers of segments, which the road must have and the release model must sum."""
    spans: tuple[int, ...] = _typed(path, value, base)
    n = corridor.geometry.n_mainline
    check_spans(n, spans)
    alone = "numbers with 1 among them on a road with loops, which say something of one segment"
    require(1 in spans or corridor.loops is None, path, alone, spans)
    if max(spans) > 1:
        model = RELEASE_MODELS.find(privacy.preset)
        plain = f"(1,) {_with_model(privacy)}, which releases no sums"
        require(model.releases_sums, path, plain, spans)
        alike = "(1,) where mainline segments differ in length"
        require(len(set(corridor.geometry.segment_lengths[:n])) == 1, path, alike, spans)
        centre = model.centre(corridor, privacy)
        require(centre is not None, path, "(1,) where mean speeds are released", spans)
    return spans


def _bandwidth(
    path: str, value: Any, base: Any, corridor: Corridor, spans: tuple[int, ...], unit: str
) -> int:
    """Return the bandwidth, which must pay for a query and not for more than the road has."""
    found: int = _typed(path, value, base)
    n, least = corridor.geometry.n_mainline, spans[0] if unit == "segments" else 1
    reason = f", to pay for a query of {least} segments" if least > 1 else ""
    require(least <= found <= n, path, f"in {least}..{n}{reason}", found)
    return found


def _limited_bandwidth(base: int, corridor: Corridor, *_: Any) -> int:
    """Return the preset's bandwidth, or, with a warning, all segments of a shorter road."""
    n = corridor.geometry.n_mainline
    if n < base:
        warnings.warn(
            f"bandwidth is {n}, the number of mainline segments, since nobody gave it and "
            f"{corridor.name} is too short for the default of {base}",
            UserWarning,
            stacklevel=1,
        )
    return min(base, n)


def _observation(path: str, value: Any, base: Any) -> tuple[Any, ...]:
    """Return the blocks, of which there may be one by itself."""
    blocks: tuple[Any, ...] = _typed(path, (value,) if isinstance(value, str) else value, base)
    for block in blocks:
        if not (isinstance(block, str) and block == DEFAULT):
            BLOCKS.find(block)
    return blocks


def _horizon(
    path: str, value: Any, base: Any, corridor: Corridor, random_start: bool
) -> int | None:
    """Return the length of an episode, which the record must have, and more for a random start."""
    found: int | None = _typed(path, value, base)
    most = corridor.conditions.duration - random_start
    allowed = f"in 1..{most}, shorter than the record for a random start"
    fits = (corridor.conditions.duration if found is None else found) <= most
    require(fits, path, allowed if random_start else f"in 1..{most}", found)
    return found


def _query_every(path: str, value: Any, base: Any, corridor: Corridor, horizon: int | None) -> int:
    """Return the seconds of a step, at most those of an episode."""
    found: int = _typed(path, value, base)
    most = corridor.conditions.duration if horizon is None else horizon
    require(found <= most, path, f"at most the {most} s of an episode", found)
    return found


def _seeds(path: str, value: Any, base: Any, corridor: Corridor) -> tuple[int, ...]:
    """Return distinct traffic seeds, a sequence or ``"first:stop"``, as far as recorded."""
    seeds: tuple[int, ...] = _typed(
        path, parse_seeds(value, path) if isinstance(value, str) else value, base
    )
    n = len(seeds)
    require(1 <= n <= MOST_SEEDS, path, f"1 to {MOST_SEEDS} seeds", f"{n} of them")
    require(len(set(seeds)) == n, path, "distinct", seeds)
    if corridor.recordings is not None:
        require_seeds(corridor.recordings, seeds, path)
    return seeds


def _recorded_seeds(base: tuple[int, ...], corridor: Corridor) -> tuple[int, ...]:
    """Return the preset's traffic seeds, or those of training that were recorded on the road.

    Where none of these was, they are all that there are.
    """
    if corridor.recordings is None:
        return base
    recorded = recorded_seeds(corridor.recordings)
    return tuple(seed for seed in recorded if seed in TRAINING_SEEDS) or recorded


def parse_seeds(text: str, path: str = "seeds") -> tuple[int, ...]:
    """Return the seeds that ``"first:stop"`` or ``"one"`` stands for, ``stop`` left out.

    Raises:
        ValueError: The text is neither, or the range is empty or too long.
    """
    first, colon, stop = text.partition(":")
    is_range = first.isdecimal() and (stop.isdecimal() or not colon) and len(text) <= 40
    require(is_range, path, "'first:stop' or one seed", text)
    seeds = range(int(first), int(stop) if colon else int(first) + 1)
    require(seeds.stop > seeds.start, path, "a range of seeds that is not empty", text)
    require(seeds.stop - seeds.start <= MOST_SEEDS, path, f"at most {MOST_SEEDS} seeds", text)
    return tuple(seeds)


# The table ----------------------------------------------------------------------------------------


class Keyword(NamedTuple):
    """A keyword of an environment.

    Attributes:
        read: Function of its path, its value, the preset's value and the fields that it ``needs``;
            it returns the value of the field.
        needs: Fields that stand before it in the table.
        default: Function of the preset's value and the fields that it ``needs``, for the value
            where none is given; None for the preset's.
    """

    read: Callable[..., Any] = _typed
    needs: tuple[str, ...] = ()
    default: Callable[..., Any] | None = None


KEYWORDS = {
    "corridor": Keyword(_corridor),
    "privacy": Keyword(_privacy, ("corridor",)),
    "penetration": Keyword(_penetration, ("corridor", "privacy")),
    "sensor_settings": Keyword(_sensor_settings, ("corridor", "privacy")),
    "fusion": Keyword(),
    "estimator": Keyword(_estimator, ("corridor",)),
    "backend": Keyword(_backend, ("estimator", "corridor")),
    "parameters": Keyword(_parameters),
    "estimator_settings": Keyword(
        _settings,
        ("estimator", "parameters", "privacy", "corridor"),
        default=_settings_of_paper,
    ),
    "query_spans": Keyword(_spans, ("corridor", "privacy")),
    "bandwidth_unit": Keyword(),
    "bandwidth": Keyword(
        _bandwidth, ("corridor", "query_spans", "bandwidth_unit"), default=_limited_bandwidth
    ),
    "action": Keyword(partial(_part, ACTION_ENCODINGS)),
    "observation": Keyword(_observation),
    "reward": Keyword(partial(_part, REWARDS)),
    "random_start": Keyword(),
    "horizon": Keyword(_horizon, ("corridor", "random_start")),
    "query_every": Keyword(_query_every, ("corridor", "horizon")),
    "traffic_seeds": Keyword(_seeds, ("corridor",), default=_recorded_seeds),
    "truth_in_info": Keyword(),
}
"""The keywords of an environment, each after those that it needs: the fields of `EnvConfig`."""

SHORTCUTS = {
    "demand": "corridor", "incident": "corridor", "loops": "corridor", "epsilon": "privacy",
    "delta": "privacy",
}  # fmt: skip
"""Keywords that stand for a field of another one."""


class UnknownKeywordError(TypeError, ValueError):
    """A keyword that an environment does not have.

    A ``TypeError`` as for any function, since libraries that try keywords on environments look for
    it, and a ``ValueError`` as for every other bad keyword.
    """


def _require_known(keywords: Iterable[str], origins: Mapping[str, str]) -> None:
    """Refuse a keyword that there is not, and say what has such a field."""
    unknown = [key for key in keywords if key not in {*KEYWORDS, *SHORTCUTS}]
    if not unknown:
        return
    key = unknown[0]
    # A plugin that nobody has used yet is a name.
    models = [each for each in RELEASE_MODELS.values() if not isinstance(each, str)]
    fields = {
        "privacy": {name for each in models for name in field_hints(each.settings_type)},
        "corridor": Corridor.hints(),
    }
    hints = [
        f"it is a field of {name}, {name}={{{key!r}: ...}}; "
        for name, known in fields.items()
        if key in known
    ]
    raise UnknownKeywordError(
        f"{origins.get(key, '')}{cut(key)} is unknown; {''.join(hints)}allowed: "
        f"{', '.join((*KEYWORDS, *SHORTCUTS))} (got an unexpected keyword argument {shown(key)})"
    )


PRESETS = {
    "paper-highway": EnvConfig(estimator_settings=PUBLISHED),
    "private-highway": EnvConfig(
        demand="random",
        incident="random",
        estimator="recurrent",
        parameters="w99-3lane",
        bandwidth=1,
        privacy=PacedSettings(epsilon=5.0),
    ),
    "long-highway": EnvConfig(
        corridor="long-highway",
        estimator="recurrent",
        parameters="w99-3lane",
        bandwidth=2,
        privacy=PacedSettings(epsilon=5.0),
    ),
    "short-highway": EnvConfig(
        corridor="short-highway", estimator="recurrent", parameters="w99-3lane", bandwidth=1
    ),
}
"""Configurations by name: that of the paper, with its filter, and those to learn on.

These have the best estimator, and so few queries that it pays to choose them.
"""


def resolve(preset: str, overrides: Mapping[str, Any]) -> EnvConfig:
    """Return a preset with some of its keywords replaced.

    A corridor that ends in ``.toml`` is a road file, whose table ``environment`` gives keywords
    that are not among ``overrides``, but for settings in a file that were tuned for another
    estimator.

    Args:
        preset: A name in `PRESETS`.
        overrides: Values of `KEYWORDS` and `SHORTCUTS`.

    Raises:
        UnknownKeywordError: There is no such keyword.
        ValueError: A value is out of range; the message starts with its path, and before that with
            the road file that has it.

    Warns:
        UserWarning: The corridor is another road, or the ARZ parameters are of one's own, and
            values that were measured or tuned for others, or assumed, are used; or no settings of
            the estimator were tuned; or the road is too short for the default bandwidth.
    """
    require_name("preset", preset, PRESETS)
    base, values, origins = PRESETS[preset], {**overrides}, dict[str, str]()
    assumed: tuple[str, ...] = ()
    path = overrides.get("corridor")
    if is_road_file(path):
        road = read_road(path)
        table = {key: value for key, value in road.environment.items() if key not in overrides}
        estimator = overrides.get("estimator", table.get("estimator", base.estimator))
        origins = {"corridor": f"{path}: ", **dict.fromkeys(table, f"{path}: environment.")}
        with within(f"{path}: environment.estimator_settings: "):
            if _is_tuned_for_another(table.get("estimator_settings"), estimator):
                del table["estimator_settings"]
        values, assumed = {**table, **overrides, "corridor": road.corridor}, road.assumed
    _require_known(values, origins)
    config = EnvConfig(base, origins=origins, **values)
    made_for = config.made_for()
    inherited = (*_inherited(config, values, assumed), *made_for)
    if not inherited:
        return config
    advice = [*made_for.values()]
    if not all(each.startswith("estimator_settings") for each in inherited):
        advice.append("`dptse fit` fits parameters to a road file")
    if "estimator_settings" in inherited:
        advice.append("`dptse fit --tune` tunes settings")
    warnings.warn(
        f"{', '.join(inherited)}: values measured or tuned on another road or with other "
        "parameters, or assumed, or defaults that nobody tuned, are used; " + "; ".join(advice),
        UserWarning,
        stacklevel=1,  # one place, so that Python tells it once, however environments are made
    )
    return replace(config, inherited=inherited)


def _is_tuned_for_another(settings: Any, estimator: Any) -> bool:
    """Return whether settings are a file of those that were tuned for another estimator."""
    if not (isinstance(settings, str) and settings.endswith(".json")):
        return False
    name = estimator if isinstance(estimator, str) else ESTIMATORS.name_of(estimator)
    return tuned_estimator(settings) != name


def _inherited(
    config: EnvConfig, given: Mapping[str, Any], assumed: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the keywords whose values are of another road or parameters, assumed, or untuned."""
    corridor, parameters = config.corridor, config.parameters
    is_other_road = corridor.geometry not in [each.corridor.geometry for each in PRESETS.values()]
    found = []
    if is_other_road:
        found = [f"corridor.{name}" for name in assumed]
        fields = given.get("corridor")
        if isinstance(fields, Mapping) and "average_dwell" not in fields:
            found.append("corridor.average_dwell")
        if "parameters" not in given:
            found.append("parameters")
    is_other = is_other_road or parameters != load_parameters(tuned_with(parameters))
    if given.get("estimator_settings") is None and _is_untuned(config, is_other):
        found.append("estimator_settings")
    return tuple(found)


def _is_untuned(config: EnvConfig, is_other: bool) -> bool:
    """Return whether settings in force are those of another road or parameter set, or defaults.

    Nobody expects tuned ones where the estimator or the release model is one's own.
    """
    name = config.settings_name
    if name is None:
        return is_tuned(config.estimator) and config.privacy.preset in RELEASE_MODELS
    return is_other or is_of_another_road(name, config.corridor.name)


def _played(config: EnvConfig) -> Played:
    """Return the numbers of an environment that cards of weights may name."""
    conditions, share = config.corridor.conditions, config.penetration.share
    limit = config.corridor.geometry.largest_speed_limit
    slow = [
        each
        for each in conditions.vehicle_classes
        if each.largest_speed is not None and each.largest_speed < limit
    ]
    own = [each.drivers or conditions.drivers for each in conditions.vehicle_classes]
    headways = [each.headway for each in own or [conditions.drivers]]
    return {
        "flows": (config.releases_flow,),
        "own_parameters": (config.parameters.is_own,),
        "span": (max(config.query_spans),),
        "epsilon": (config.privacy.epsilon,),
        "connected": share if isinstance(share, tuple) else (share,),
        "slow_share": (sum(each.share for each in slow),),
        "slow_speed": [each.largest_speed for each in slow if each.largest_speed is not None],
        "headway": [each for each in headways if each is not None],
    }
