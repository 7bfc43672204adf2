"""The parts of an environment, made of its configuration."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from dptse_env.config import TIME_STEP, EnvConfig
from dptse_env.measurement import (
    BOUNDARIES,
    BoundaryModel,
    make_groups,
)
from dptse_env.model import ARZModel
from dptse_env.release import (
    RELEASE_MODELS,
    VOID_REASONS,
    PrivacyReport,
    Queries,
    ReleaseModel,
    Task,
    Traffic,
)
from dptse_env.release.report import in_order
from dptse_env.spaces.actions import ACTION_ENCODINGS, ActionEncoding
from dptse_env.spaces.observations import ObservationEncoding
from dptse_env.spaces.rewards import make_reward
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.arrays import BoolArray, Observation


@dataclass(frozen=True)
class QueryInterface:
    """The interface of an environment to a policy; it holds no state of episodes.

    Attributes:
        queries: The queries to choose from.
        actions: The action encoding, with its space.
        observations: The observation encoding, with its space and block names.
        reward: The reward, a function of a `dptse_env.spaces.rewards.ScoredSecond`; its attribute
            ``term`` says which errors greedy schedules weigh.
    """

    queries: Queries
    actions: ActionEncoding
    observations: ObservationEncoding
    reward: Any

    def picked(self, observation: Observation) -> BoolArray:
        """Return the queries picked so far for the next query, shape (..., G).

        Args:
            observation: Shape (..., size); without a block ``picked`` there are none.
        """
        if "picked" not in self.observations.slices:
            return np.zeros((*observation.shape[:-1], self.queries.n_queries), dtype=bool)
        return self.observations.block(observation, "picked") > 0


def make_interface(config: EnvConfig) -> QueryInterface:
    """Make the interface that ``config`` describes.

    Raises:
        ValueError: A part of another package is not what is expected.
    """
    encoding, queries = ACTION_ENCODINGS.find(config.action), config.queries
    actions = encoding(queries)
    return QueryInterface(
        queries=queries,
        actions=actions,
        observations=ObservationEncoding(
            make_task(config), config.observation, picks_one_by_one=actions.actions_per_step > 1
        ),
        reward=make_reward(config.reward),
    )


def make_model(config: EnvConfig) -> ARZModel:
    """Make the traffic model of the estimator, with a time step of one second."""
    task = make_task(config)
    return ARZModel(
        config.corridor.road,
        config.parameters,
        TIME_STEP,
        centre=task.centre,
        channels=task.channels.head(task.n_on_road),
    )


def make_task(config: EnvConfig, n_episodes: int = 1) -> Task:
    """Make what is measured in a batch of episodes."""
    privacy, model = config.privacy, config.release_model
    return Task(
        name=RELEASE_MODELS.name_of(privacy.preset),
        settings=privacy,
        corridor=config.corridor,
        queries=config.queries,
        horizon=config.horizon_steps,
        centre=model.centre(config.corridor, privacy),
        has_prices=model.has_prices,
        n_episodes=n_episodes,
        query_every=config.query_every,
        groups=make_groups(
            config.penetration,
            config.sensor_settings,
            config.corridor,
            private_boundary=privacy.boundary == "private",
        ),
    )


def make_traffic(config: EnvConfig, library: RecordLibrary | None = None) -> Traffic:
    """Make the tables of the true traffic; nothing is recorded or loaded."""
    task = make_task(config)
    reads_vehicles = config.release_model.needs_vehicles or not task.is_whole
    populations = [group.population for group in task.groups] if reads_vehicles else []
    return Traffic(config.corridor, config.traffic_seeds, library or RecordLibrary(), populations)


def make_release(
    config: EnvConfig, n_episodes: int = 1, traffic: Traffic | None = None
) -> ReleaseModel:
    """Make the release model for a batch of episodes; nothing is recorded or loaded.

    Args:
        config: The configuration.
        n_episodes: Size n of the batch.
        traffic: The true traffic; made of the user's records if None.
    """
    task, traffic = make_task(config, n_episodes), traffic or make_traffic(config)
    release: ReleaseModel = config.release_model(task, traffic)
    return release


def privacy_report(config: EnvConfig) -> PrivacyReport:
    """Return the privacy report of a configuration."""
    return complete_report(config, make_release(config), BOUNDARIES[config.privacy.boundary])


def complete_report(
    config: EnvConfig, release: ReleaseModel, boundary: BoundaryModel | type[BoundaryModel]
) -> PrivacyReport:
    """Return a release model's report, voided where anything else depends on the traffic.

    Loops void nothing: the guarantee is one given what they show.
    """
    shown = ("truth_in_info",) if config.truth_in_info else ()
    measured = ("measured_values",) if config.corridor.measured else ()
    report, loops = release.report(), config.corridor.loops
    if loops is not None:
        report = report.beside(loops)
    return report.voided((*boundary.void_reasons, *measured, *shown))


def warn_where_void(config: EnvConfig) -> None:
    """Warn where a release model that gives a guarantee was asked for, and other fields void it."""
    if not config.release_model.claims_guarantee:
        return
    # Who asks for the truth in info knows that it is shown. Imported and fitted roads are for
    # experiments on their own traffic.
    reasons = set(privacy_report(config).void_reasons) - {"truth_in_info", "measured_values"}
    if reasons:
        # A release model of another package may have reasons of its own, which explain themselves.
        listed = "; ".join(
            f"{reason}: {VOID_REASONS[reason]}" if reason in VOID_REASONS else reason
            for reason in in_order(reasons)
        )
        warnings.warn(
            f"privacy.preset is {config.privacy.preset!r}, yet no privacy is guaranteed. {listed}",
            UserWarning,
            stacklevel=1,  # one place, so that Python tells it once, however environments are made
        )
