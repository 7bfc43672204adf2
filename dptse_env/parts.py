"""The parts of an environment, made of its configuration."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from dptse_env.config import TIME_STEP, EnvConfig
from dptse_env.estimators import Estimator, make_estimator
from dptse_env.fusion import Fusion
from dptse_env.model import ARZModel
from dptse_env.release import (
    BOUNDARIES,
    RELEASE_MODELS,
    VOID_REASONS,
    BoundaryModel,
    PrivacyReport,
    QueryOptions,
    ReleaseModel,
    ReleaseSetup,
    TrafficTable,
    TwoMechanisms,
)
from dptse_env.release.report import in_order
from dptse_env.spaces.actions import ACTION_ENCODINGS, ActionEncoding
from dptse_env.spaces.observations import ObservationEncoding, ObservationSetup
from dptse_env.spaces.rewards import make_reward
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.registry import name_of_class


@dataclass(frozen=True)
class QueryInterface:
    """The interface of an environment to a policy; it holds no state of episodes.

    Attributes:
        queries: The options that can be queried.
        actions: The action encoding, with its space.
        observations: The observation encoding, with its space and block names.
        reward: The reward, a function of a `dptse_env.spaces.rewards.ScoredSecond`; its attribute
            ``term`` says which errors greedy schedules weigh.
    """

    queries: QueryOptions
    actions: ActionEncoding
    observations: ObservationEncoding
    reward: Any

    @property
    def n_mainline(self) -> int:
        """Number of mainline segments."""
        return self.queries.n_mainline

    @property
    def bandwidth(self) -> int:
        """Largest cost of a step's queries together."""
        return self.queries.bandwidth

    def require_sequential(self) -> None:
        """Raise ``ValueError`` unless an action picks one option, as for ``"sequential"``."""
        if not self.actions.picks_one_by_one:
            raise ValueError(
                "action_masks() needs action='sequential' or another encoding that picks one "
                f"option per action, got {name_of_class(self.actions)}"
            )


@dataclass(frozen=True)
class Parts:
    """The parts of a decision process, for a batch of n episodes.

    Attributes:
        config: The configuration.
        interface: Action encoding, observation and reward.
        traffic: The true traffic.
        release: What leaves the road.
        model: The traffic model of the estimator and the boundary.
        boundary: The model's inputs at the road's ends and ramps.
        estimator: The estimator.
        fusion: What turns releases into measurements of all vehicles; None where they are.
    """

    config: EnvConfig
    interface: QueryInterface
    traffic: TrafficTable
    release: ReleaseModel
    model: ARZModel
    boundary: BoundaryModel
    estimator: Estimator
    fusion: Fusion | None

    @property
    def n_episodes(self) -> int:
        """Size n of the batch."""
        return self.estimator.n_episodes


def make_interface(config: EnvConfig) -> QueryInterface:
    """Make the interface that ``config`` describes.

    Raises:
        ValueError: A part of another package is not what is expected.
    """
    corridor, queries = config.corridor, config.queries
    encoding = ACTION_ENCODINGS.find(config.action)
    actions = encoding(queries.n_options, queries.bandwidth, queries.cost)
    setup = ObservationSetup(
        corridor,
        config.bandwidth,
        config.privacy.epsilon,
        n_options=queries.n_options,
        sensor_rows=queries.sensor_rows(corridor),
        releases_flow=flow_centre(config) is not None,
        picks_one_by_one=actions.actions_per_step > 1,
        has_prices=RELEASE_MODELS.find(config.privacy.preset).has_prices,
    )
    return QueryInterface(
        queries=queries,
        actions=actions,
        observations=ObservationEncoding(setup, config.observation),
        reward=make_reward(config.reward),
    )


def flow_centre(config: EnvConfig) -> float | None:
    """Return the speed [km/h] that released flows are centred on; None for mean speeds."""
    model = RELEASE_MODELS.find(config.privacy.preset)
    centre: float | None = model.flow_centre(config.corridor, config.privacy)
    return centre


def make_model(config: EnvConfig) -> ARZModel:
    """Make the traffic model of the estimator, with a time step of one second."""
    return ARZModel(
        config.corridor,
        config.arz_parameters,
        TIME_STEP,
        reference_speed=flow_centre(config),
        rows=config.queries.rows(config.corridor),
    )


def make_release(
    config: EnvConfig, n_episodes: int = 1, traffic: TrafficTable | None = None
) -> ReleaseModel:
    """Make the release model for a batch of episodes; nothing is recorded or loaded.

    Args:
        config: The configuration.
        n_episodes: Size n of the batch.
        traffic: The true traffic; made of the user's records if None.
    """
    preset = config.privacy.preset
    model: type[ReleaseModel] = RELEASE_MODELS.find(preset)
    setup = ReleaseSetup(
        name=RELEASE_MODELS.name_of(preset),
        settings=config.privacy,
        traffic=make_traffic(config) if traffic is None else traffic,
        bandwidth=config.bandwidth,
        horizon=config.horizon_steps,
        n_episodes=n_episodes,
        queries=config.queries,
    )
    if config.has_separate_sensors:
        return TwoMechanisms(model, setup, config.penetration, config.detectors)
    return model(setup)


def make_traffic(config: EnvConfig, library: RecordLibrary | None = None) -> TrafficTable:
    """Make the table of the true traffic; nothing is recorded or loaded."""
    return TrafficTable(config.corridor, config.traffic_seeds, library or RecordLibrary())


def make_fusion(config: EnvConfig, model: ARZModel) -> Fusion | None:
    """Make what turns releases into measurements of all vehicles; None where they are."""
    if not config.has_separate_sensors:
        return None
    corridor, rows = config.corridor, model.rows
    return Fusion(
        config.fusion,
        rows,
        n_options=config.queries.n_options,
        lengths=np.array(corridor.segment_lengths)[rows.first] * rows.span,
        share=config.penetration.published_share,
        limits=np.array(corridor.speed_limits)[rows.first],
        releases_flow=flow_centre(config) is not None,
    )


def privacy_report(config: EnvConfig) -> PrivacyReport:
    """Return the privacy report of a configuration."""
    return complete_report(config, make_release(config), BOUNDARIES[config.privacy.boundary])


def complete_report(
    config: EnvConfig, release: ReleaseModel, boundary: BoundaryModel | type[BoundaryModel]
) -> PrivacyReport:
    """Return a release model's report, voided where anything else shows the true traffic."""
    shown = ("truth_in_info",) if config.truth_in_info else ()
    return release.report().voided((*boundary.void_reasons, *shown))


def warn_where_void(config: EnvConfig) -> None:
    """Warn where a release model that gives a guarantee was asked for, and other fields void it.

    The warning names the line that called the caller, the constructor of an environment.
    """
    if not RELEASE_MODELS.find(config.privacy.preset).claims_guarantee:
        return
    # Who asks for the truth in info knows that it is shown.
    reasons = set(privacy_report(config).void_reasons) - {"truth_in_info"}
    if reasons:
        # A release model of another package may have reasons of its own, which explain themselves.
        listed = "; ".join(
            f"{reason}: {VOID_REASONS[reason]}" if reason in VOID_REASONS else reason
            for reason in in_order(reasons)
        )
        warnings.warn(
            f"privacy.preset is {config.privacy.preset!r}, yet no privacy is guaranteed. {listed}",
            UserWarning,
            stacklevel=3,
        )


def make_parts(
    config: EnvConfig,
    n_episodes: int = 1,
    library: RecordLibrary | None = None,
    *,
    interface: QueryInterface | None = None,
    traffic: TrafficTable | None = None,
    release: ReleaseModel | None = None,
    model: ARZModel | None = None,
    boundary: BoundaryModel | None = None,
    estimator: Estimator | None = None,
) -> Parts:
    """Make the parts that a configuration describes, for a batch of episodes.

    A part that is given is used as it is, and parts that are made of it follow. Reports describe
    the parts in force.

    Args:
        config: The configuration.
        n_episodes: Size n of the batch.
        library: Source of the records; the user's cache if None.
        interface: See `Parts`, as for the parts below.
        traffic: Shared by several processes, records are in memory once.
        release: Made for n episodes and this traffic.
        model: The traffic model.
        boundary: Made for n episodes.
        estimator: Of n episodes.

    Raises:
        ValueError: A part of another package is not what is expected.
    """
    interface = interface or make_interface(config)
    traffic = traffic or make_traffic(config, library)
    release = release or make_release(config, n_episodes, traffic)
    model = model or make_model(config)
    boundary = boundary or BOUNDARIES[config.privacy.boundary](traffic, model, n_episodes)
    estimator = estimator or make_estimator(
        config.estimator, config.backend, model, n_episodes, config.settings()
    )
    fusion = make_fusion(config, model)
    return Parts(config, interface, traffic, release, model, boundary, estimator, fusion)
