"""The configuration of an environment: a dataclass, presets, and keywords that change these.

Everything is reachable from plain JSON, so the keywords of ``gym.make`` survive a spec. A
configuration holds and checks; `dptse_env.parts` makes what it describes.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any

from dptse_env.estimators import (
    ESTIMATORS,
    check_estimator,
    check_settings,
    checked_settings,
    settings_type,
)
from dptse_env.estimators.settings import (
    read_settings,
    tuned_estimator,
    tuned_settings,
    tuned_with,
)
from dptse_env.model import ARZModel, ARZParameters, available_parameters, load_parameters
from dptse_env.model.parameters import read_parameters
from dptse_env.release import (
    RELEASE_MODELS,
    BandwidthUnit,
    Detectors,
    FusionSettings,
    PacedSettings,
    PrivacySettings,
    QueryOptions,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.spaces.observations import BLOCKS, DEFAULT
from dptse_env.spaces.rewards import REWARDS
from dptse_env.traffic import (
    CORRIDORS,
    Corridor,
    Penetration,
    find_corridor,
    is_road_file,
    randomised,
    read_road,
)
from dptse_env.traffic.imported import has_vehicles, recorded_seeds, require_seeds
from dptse_env.traffic.roads import RoadFile
from dptse_env.utils.fields import (
    Interval,
    checked_fields,
    cut,
    field_hints,
    from_mapping,
    require,
    require_name,
    shown,
)
from dptse_env.utils.registry import OR_IMPORTED

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


@dataclass(frozen=True)
class EnvConfig:
    """Everything that an environment is made of.

    Attributes:
        corridor: The road, its demand, incident and fixed sensors.
        estimator: The estimator: ``ekf``, ``ukf``, ``enkf``, ``mhe``, ``random_walk``,
            ``blend``, ``open_loop``, ``recurrent``, ``asm``, ``mixture``, a registered name,
            ``"package.module:Class"``, or a class.
        backend: ``compiled``, or ``reference``, which EKF, UKF, EnKF and MHE have.
        parameters: ARZ parameters, or the name of a set.
        estimator_settings: Tuning of the estimator, or the name of a shipped set
            (`dptse_env.estimators.settings`), whichever estimator it was tuned for. None for the
            set ``<estimator>-<ARZ parameters>-<privacy preset>-<corridor>``, or that without the
            corridor's name, if one ships, else the estimator's defaults. Parameters of one's own
            take those of the shipped ones that they were derived from.
        bandwidth: Largest total cost of the queries of a step, in ``bandwidth_unit``; by default a
            number of mainline segments. `resolve` limits a default to those that there are.
        query_spans: Numbers of neighbouring mainline segments that one query may cover, ascending.
            Several segments are released as one sum. Others than 1 need a release model that
            releases sums.
        price_levels: Factors on the release model's price among which a query chooses. Others than
            1 need a release model that releases sums.
        bandwidth_unit: Cost of a query: ``segments``, the number of segments that it covers, or
            ``sums``, one.
        action: The action encoding: ``mask``, ``scores``, ``slots``, ``sequential``, a registered
            name, ``"package.module:Class"``, or a class.
        observation: Blocks of the observation, in order: names, ``"package.module:Class"``, classes
            or objects; ``"default"`` stands for all default blocks.
        privacy: The release model with its epsilon, delta and unit of protection.
        penetration: The vehicles that are connected and answer queries; a number is their share.
        detectors: Errors of the fixed sensors, and their part of the privacy budget.
        fusion: Settings by which answers of connected vehicles and fixed sensors become
            measurements.
        reward: The reward: ``joint``, ``density``, ``speed``, a registered name,
            ``"package.module:function"``, or a function of a `ScoredSecond`.
        horizon: Length of an episode [s]; None for the whole record.
        random_start: Whether an episode starts at a random second of the record.
        traffic_seeds: Traffic seeds to draw episodes from; on a road with recordings `resolve` puts
            the recorded training seeds in place of this default.
        truth_in_info: Whether ``info`` shows the true traffic.
        inherited: Keywords whose values were measured or tuned on another road than this one, or
            with other ARZ parameters, and that nobody gave; filled in by `resolve`.

    Raises:
        ValueError: A value is out of range.
    """

    corridor: Corridor
    estimator: Any = "ekf"
    backend: str = "compiled"
    parameters: str | ARZParameters = "paper"
    estimator_settings: Any = None
    bandwidth: Annotated[int, Interval(1, 1000)] = 5
    query_spans: tuple[Annotated[int, Interval(1, 1000)], ...] = (1,)
    price_levels: tuple[Annotated[float, Interval(0.05, 20)], ...] = (1.0,)
    bandwidth_unit: BandwidthUnit = "segments"
    action: Any = "mask"
    observation: tuple[Any, ...] = (DEFAULT,)
    privacy: PrivacySettings = field(default_factory=PrivacySettings)
    penetration: Penetration = field(default_factory=Penetration)
    detectors: Detectors = field(default_factory=Detectors)
    fusion: FusionSettings = field(default_factory=FusionSettings)
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
        check_estimator(self.estimator, self.backend)
        n, duration, seeds = self.corridor.n_mainline, self.corridor.duration, self.traffic_seeds
        require(self.bandwidth <= n, "bandwidth", f"in 1..{n}", self.bandwidth)
        require(self.horizon_steps <= duration, "horizon", f"in 1..{duration}", self.horizon)
        if self.random_start:
            shorter = f"below the record's {duration} s where random_start is true"
            require(self.horizon_steps < duration, "horizon", shorter, self.horizon)
        most = f"1 to {MOST_SEEDS} seeds"
        require(1 <= len(seeds) <= MOST_SEEDS, "traffic_seeds", most, f"{len(seeds)} of them")
        require(len(set(seeds)) == len(seeds), "traffic_seeds", "distinct", seeds)
        self._check_queries()
        self._check_sensors()
        if isinstance(self.parameters, str):
            require_name("parameters", self.parameters, available_parameters())
        self.settings()

    def _check_queries(self) -> None:
        """Check the options, and that the release model can answer them."""
        _ = self.queries  # refuses bad values
        model, spans = RELEASE_MODELS.find(self.privacy.preset), self.query_spans
        plain = (
            f"(1,) with the release model {RELEASE_MODELS.name_of(model)!r}, which releases no sums"
        )
        for key in ("query_spans", "price_levels"):
            value = getattr(self, key)
            require(value == (1,) or model.releases_sums, key, plain, value)
        if max(spans) > 1:
            lengths = set(self.corridor.segment_lengths[: self.corridor.n_mainline])
            alike = "(1,) where mainline segments differ in length"
            require(len(lengths) == 1, "query_spans", alike, spans)
            centre = model.flow_centre(self.corridor, self.privacy)
            require(centre is not None, "query_spans", "(1,) where mean speeds are released", spans)

    def _check_sensors(self) -> None:
        """Check that the road has what penetration, detectors and the release model need."""
        n, factor, recordings = (
            len(self.corridor.fixed_sensors), self.detectors.factor, self.corridor.recordings
        )  # fmt: skip
        each = f"one number, or one for each of the {n} fixed sensors"
        require(not isinstance(factor, tuple) or len(factor) == n, "detectors.factor", each, factor)
        has_some = n > 0 or self.detectors == Detectors()
        require(has_some, "detectors", "left out on a road without fixed sensors", self.detectors)
        if recordings is None:
            return
        require_seeds(recordings, self.traffic_seeds)
        if not has_vehicles(recordings):
            preset, share = self.privacy.preset, self.penetration.share
            blind = "one that needs no vehicles, as 'paper', on a road of measured fields"
            is_blind = not RELEASE_MODELS.find(preset).needs_vehicles
            require(is_blind, "privacy.preset", blind, RELEASE_MODELS.name_of(preset))
            whole = "1, and detectors left out, on a road of measured fields"
            require(not self.has_separate_sensors, "penetration.share", whole, share)

    @property
    def has_separate_sensors(self) -> bool:
        """True if fixed sensors measure other things than queries do."""
        return not self.penetration.is_complete or self.detectors != Detectors()

    @cached_property
    def queries(self) -> QueryOptions:
        """The queries among which a policy chooses."""
        return QueryOptions.make(
            self.corridor.n_mainline,
            self.bandwidth,
            self.query_spans,
            self.price_levels,
            self.bandwidth_unit,
            self.has_separate_sensors,
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
        # A road of one's own takes no variant that happens to have its name.
        road = self.corridor.name if self.corridor.name in CORRIDORS else ""
        return tuned_settings(self.estimator, self.arz_parameters, self.privacy.preset, road)

    def settings(self) -> Any:
        """Return the estimator's settings in force, of its settings' type.

        Raises:
            ValueError: They are no settings of this estimator.
        """
        return checked_settings(self.estimator, self.settings_name or self.estimator_settings)


PRESETS = {
    "paper-highway": EnvConfig(corridor=CORRIDORS["paper-highway"]),
    "private-highway": EnvConfig(
        corridor=randomised(CORRIDORS["paper-highway"]),
        parameters="w99-3lane",
        privacy=PacedSettings(epsilon=5.0),
    ),
    "long-highway": EnvConfig(
        corridor=CORRIDORS["long-highway"],
        parameters="w99-3lane",
        bandwidth=8,
        privacy=PacedSettings(epsilon=5.0),
    ),
    "short-highway": EnvConfig(corridor=CORRIDORS["short-highway"], bandwidth=2),
}
"""Configurations by name."""


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
            values that were measured or tuned for others, or assumed, are used; or the road is too
            short for the default bandwidth.
    """
    require_name("preset", preset, PRESETS)
    corridor = overrides.get("corridor")
    road = read_road(corridor) if is_road_file(corridor) else None
    try:
        config, inherited = _resolve(PRESETS[preset], overrides, road)
    except ValueError as problem:
        raise _of_file(problem, overrides, road) from problem
    if inherited and not config.inherited:
        config = replace(config, inherited=inherited)
        warnings.warn(
            f"{', '.join(inherited)}: values measured or tuned on {PRESETS[preset].corridor.name}, "
            "or assumed, are used on another road or with other parameters; `dptse fit` "
            "fits parameters to a road file, `dptse tune` tunes settings",
            UserWarning,
            stacklevel=1,  # one place, so that Python tells it once, however environments are made
        )
    return config


def _of_file(
    problem: ValueError, overrides: Mapping[str, Any], road: RoadFile | None
) -> ValueError:
    """Return an error with the road file in front where the value that it names comes from it."""
    if road is None:
        return problem
    own = [key for key in road.environment if key not in overrides]
    places = [(path, "environment.") for key in own for path in (key, _SHORTCUTS.get(key, key))]
    for path, table in (*places, ("corridor", "")):
        if str(problem).startswith(cut(path)):
            said = str(problem).replace(OR_IMPORTED, "")
            return type(problem)(f"{overrides['corridor']}: {table}{said}")
    return problem


def check_road(config: EnvConfig, model: ARZModel, overrides: Mapping[str, Any]) -> None:
    """Refuse an estimator's settings on a road, and a road for an estimator.

    Args:
        config: What `resolve` made of the overrides.
        model: Its traffic model.
        overrides: The keywords.

    Raises:
        ValueError: As `dptse_env.estimators.check_settings`, with the road file in front where the
            value that it names comes from it.
    """
    try:
        check_settings(config.estimator, model, config.settings())
    except ValueError as problem:
        path = overrides.get("corridor")
        road = read_road(path) if is_road_file(path) else None
        raise _of_file(problem, overrides, road) from problem


def _resolve(
    base: EnvConfig, overrides: Mapping[str, Any], road: RoadFile | None
) -> tuple[EnvConfig, tuple[str, ...]]:
    """Return a configuration, and the keywords that it inherits from another road."""
    corridor = overrides.get("corridor")
    values = {**road.environment, **overrides, "corridor": road.corridor} if road else {**overrides}
    _check_keywords(values)
    estimator = values.get("estimator", base.estimator)
    if road and "estimator_settings" not in overrides and _is_tuned_for_another(values, estimator):
        del values["estimator_settings"]
    _read_files(values)
    given = {**values, "corridor": corridor} if road else dict(values)
    values["corridor"] = corridor = _corridor(base.corridor, values)
    values["privacy"] = _privacy(base.privacy, values)
    if not isinstance(values.get("penetration", {}), Mapping | Penetration):
        values["penetration"] = {"share": values["penetration"]}
    _read_seeds(values, corridor)
    if "bandwidth" not in values and corridor.n_mainline < base.bandwidth:
        values["bandwidth"] = corridor.n_mainline
        warnings.warn(
            f"bandwidth is {corridor.n_mainline}, the number of mainline segments, since nobody "
            f"gave it and {corridor.name} is too short for the default of {base.bandwidth}",
            UserWarning,
            stacklevel=1,
        )
    if isinstance(values.get("observation"), str):
        values["observation"] = (values["observation"],)
    settings = values.get("estimator_settings")
    changes = values.pop("estimator_settings") if isinstance(settings, Mapping) else None
    config = from_mapping(EnvConfig, values, "", base)
    if changes is not None:
        expected = settings_type(config.estimator)
        settings = from_mapping(expected, changes, "estimator_settings", config.settings())
        config = replace(config, estimator_settings=settings)
    return config, _inherited(corridor, config, given, road.assumed if road else ())


def _read_seeds(values: dict[str, Any], corridor: Corridor) -> None:
    """Replace a range of traffic seeds by these, and put recorded ones where none are given."""
    if "traffic_seeds" not in values and corridor.recordings is not None:
        recorded = recorded_seeds(corridor.recordings)
        values["traffic_seeds"] = tuple(seed for seed in recorded if seed in TRAINING_SEEDS)
    if isinstance(values.get("traffic_seeds"), str):
        values["traffic_seeds"] = parse_seeds(values["traffic_seeds"], "traffic_seeds")


def _read_files(values: dict[str, Any]) -> None:
    """Replace names of JSON files of parameters and estimator settings by their content."""
    for key, read in (("parameters", read_parameters), ("estimator_settings", read_settings)):
        value = values.get(key)
        if isinstance(value, str) and value.endswith(".json"):
            values[key] = read(value)


def _is_tuned_for_another(values: Mapping[str, Any], estimator: Any) -> bool:
    """Return whether settings are a file of those that were tuned for another estimator."""
    path = str(values.get("estimator_settings"))
    return path.endswith(".json") and tuned_estimator(path) != ESTIMATORS.name_of(estimator)


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


_SHORTCUTS = {
    "epsilon": "privacy.epsilon", "delta": "privacy.delta", "incident": "corridor.incident",
    "demand": "corridor.demand",
}  # fmt: skip
"""Keywords that stand for a field of another one."""


def _check_keywords(values: Mapping[str, Any]) -> None:
    known = (*field_hints(EnvConfig), *_SHORTCUTS)
    for key in values:
        if key not in known:
            hints = [f"it is a field of {name}, {name}={{{key!r}: ...}}; " for name in _owners(key)]
            raise UnknownKeywordError(
                f"{cut(key)} is unknown; {''.join(hints)}allowed: {', '.join(known)} (got an "
                f"unexpected keyword argument {shown(key)})"
            )


def _owners(key: str) -> list[str]:
    """Return the keywords that have a field of this name."""
    # A plugin that nobody has used yet is a name.
    models = [each for each in RELEASE_MODELS.values() if not isinstance(each, str)]
    nested = {"privacy": [each.settings_type for each in models], "corridor": [Corridor]}
    return [
        name for name, types in nested.items() if any(key in field_hints(each) for each in types)
    ]


def _corridor(base: Corridor, values: dict[str, Any]) -> Corridor:
    """Take the keywords about the corridor out of ``values`` and apply them."""
    given = values.pop("corridor", {})
    corridor = base.replaced(given) if isinstance(given, Mapping) else find_corridor(given)
    for key, names in (("demand", ()), ("incident", ("none",))):
        if key in values:
            value = values.pop(key)
            if isinstance(value, str):
                require_name(key, value, ("preset", "random", *names))
                source = randomised(corridor) if value == "random" else corridor
                value = None if value == "none" else getattr(source, key)
            corridor = corridor.replaced({key: value})
    return corridor


def _inherited(
    corridor: Corridor, config: EnvConfig, given: Mapping[str, Any], assumed: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the keywords whose values are of another road or parameter set, or assumed."""
    shipped = [preset.corridor for preset in PRESETS.values()]
    is_other_road = not any(corridor.has_geometry_of(road) for road in shipped)
    found = []
    if is_other_road:
        found = [f"corridor.{name}" for name in assumed]
        fields = given.get("corridor")
        if isinstance(fields, Mapping) and "average_dwell" not in fields:
            found.append("corridor.average_dwell")
        if isinstance(config.parameters, str) and "parameters" not in given:
            found.append("parameters")
    parameters = config.arz_parameters
    is_other = is_other_road or parameters != load_parameters(tuned_with(parameters))
    if is_other and config.settings_name is not None and "estimator_settings" not in given:
        found.append("estimator_settings")
    inherits = getattr(ESTIMATORS.find(config.estimator), "inherits", None)
    if inherits is not None:
        centre = RELEASE_MODELS.find(config.privacy.preset).flow_centre(corridor, config.privacy)
        spans = max(config.query_spans)
        found += inherits(corridor, centre is not None, spans, config.settings())
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
            f"privacy must be the name of a release model, a class or a mapping, got {shown(given)}"
        )
    given = dict(given)
    preset = given.pop("preset", base.preset)
    if not isinstance(preset, str | type):
        raise ValueError(f"privacy.preset must be a name or a class, got {shown(preset)}")
    if isinstance(preset, str):
        preset = RELEASE_MODELS.name_of(preset)
    if preset != base.preset:
        model = RELEASE_MODELS.find(preset)
        base = model.settings_type(preset=preset, epsilon=base.epsilon, delta=base.delta)
    given |= {key: values.pop(key) for key in ("epsilon", "delta") if key in values}
    return from_mapping(type(base), given, "privacy", base)
