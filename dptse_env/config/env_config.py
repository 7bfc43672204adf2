"""The configuration of an environment: one frozen dataclass, and presets.

Everything is reachable from plain JSON, so the keywords of ``gym.make`` survive a spec. A
configuration holds and checks; `dptse_env.parts` makes what it describes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

from dptse_env.estimators import check_demand, check_estimator, settings_type
from dptse_env.estimators.settings import load_settings, tuned_settings
from dptse_env.fusion import FusionSettings
from dptse_env.model import ARZParameters, available_parameters, load_parameters
from dptse_env.release import (
    RELEASE_MODELS,
    BandwidthUnit,
    CappedSettings,
    Detectors,
    PacedSettings,
    PrivacySettings,
    QueryOptions,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.spaces.observations import BLOCKS, DEFAULT
from dptse_env.spaces.rewards import REWARDS
from dptse_env.traffic import CORRIDORS, Corridor, Penetration, randomised
from dptse_env.utils.fields import Interval, checked_fields
from dptse_env.utils.validation import require_name

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
            ``blend``, ``open_loop``, ``recurrent``, a registered name, ``"package.module:Class"``,
            or a class.
        backend: ``compiled``, or ``reference``, which EKF, UKF, EnKF and MHE have.
        parameters: ARZ parameters, or the name of a set.
        estimator_settings: Tuning of the estimator, or the name of a shipped set
            (`dptse_env.estimators.settings`), whichever estimator it was tuned for. None for the
            set ``<estimator>-<ARZ parameters>-<privacy preset>-<corridor>``, or that without the
            corridor's name, if one ships, else the estimator's defaults. Parameters of one's own
            take those of the shipped ones that they were derived from.
        bandwidth: Largest total cost of the queries of a step, in ``bandwidth_unit``; by default a
            number of mainline segments.
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
        ValueError: A value is out of range, or the parameters violate the CFL condition.
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
        RELEASE_MODELS.find(self.privacy.preset)
        check_estimator(self.estimator, self.backend)
        n, duration = self.corridor.n_mainline, self.corridor.duration
        if self.bandwidth > n:
            raise ValueError(f"bandwidth must be in 1..{n}, got {self.bandwidth}")
        self._check_queries()
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
        self._check_sensors()
        if self.corridor.recordings is not None:
            self.corridor.recordings.require(seeds)
            needs = RELEASE_MODELS.find(self.privacy.preset).needs_vehicles
            if needs and not self.corridor.recordings.has_vehicles:
                raise ValueError(
                    "privacy.preset must be a release model that needs no vehicles, such as "
                    "'paper' or 'corrected', on a road of measured fields, got "
                    f"{RELEASE_MODELS.name_of(self.privacy.preset)!r}"
                )
        if isinstance(self.parameters, str):
            require_name("parameters", self.parameters, available_parameters())
        self.arz_parameters.require_time_step(TIME_STEP, min(self.corridor.segment_lengths))
        self._check_settings()

    def _check_queries(self) -> None:
        """Check the options, and that the release model can answer them."""
        _ = self.queries  # refuses bad values
        model, spans = RELEASE_MODELS.find(self.privacy.preset), self.query_spans
        for key in ("query_spans", "price_levels"):
            if getattr(self, key) != (1,) and not model.releases_sums:
                raise ValueError(
                    f"{key} must be (1,) with the release model "
                    f"{RELEASE_MODELS.name_of(model)!r}, which releases no sums, got "
                    f"{getattr(self, key)}"
                )
        lengths = self.corridor.segment_lengths[: self.corridor.n_mainline]
        if max(spans) > 1 and len(set(lengths)) > 1:
            raise ValueError(
                f"query_spans must be (1,) where mainline segments differ in length, got {spans}"
            )
        if max(spans) > 1 and model.flow_centre(self.corridor, self.privacy) is None:
            raise ValueError(
                f"query_spans must be (1,) where mean speeds are released, got {spans}"
            )

    @property
    def has_separate_sensors(self) -> bool:
        """True if fixed sensors measure other things than queries do."""
        return not self.penetration.is_complete or self.detectors != Detectors()

    def _check_sensors(self) -> None:
        """Check that the road can have this penetration and these detectors."""
        corridor, factor = self.corridor, self.detectors.factor
        if isinstance(factor, tuple) and len(factor) != len(corridor.fixed_sensors):
            raise ValueError(
                f"detectors.factor must be one number, or one for each of the "
                f"{len(corridor.fixed_sensors)} fixed sensors, got {factor}"
            )
        if self.detectors != Detectors() and not corridor.fixed_sensors:
            raise ValueError(
                f"detectors must be left out on a road without fixed sensors, got {self.detectors}"
            )
        recordings = corridor.recordings
        if self.has_separate_sensors and recordings is not None and not recordings.has_vehicles:
            raise ValueError(
                "penetration.share must be 1, and detectors left out, on a road of measured "
                "fields, which have no vehicles"
            )

    def _check_settings(self) -> None:
        settings, expected = self.estimator_settings, settings_type(self.estimator)
        if isinstance(settings, str):
            load_settings(settings)
        elif settings is not None and not isinstance(settings, expected):
            raise ValueError(
                f"estimator_settings must be a mapping, the name of a set, or a "
                f"{expected.__name__}, got {settings!r}"
            )
        check_demand(self.estimator, self.settings())

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
    "private-highway-v1": EnvConfig(
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
