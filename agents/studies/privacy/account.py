"""What noise is worth to a vehicle: epsilon as claimed, as composed, and as really met."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agents.experiments.runner import make_env
from agents.studies.privacy.plan import Cell
from dptse_env.config import EnvConfig
from dptse_env.privacy import contribution_sensitivity, epsilon_of
from dptse_env.traffic import Corridor, RecordLibrary


@dataclass(frozen=True)
class Account:
    """What a configuration's noise is worth.

    Attributes:
        claimed: The epsilon asked for.
        composed: Epsilon of both releases together, if the preset's own sensitivities held.
        density_std: Noise of a density [veh/km].
        second_std: Noise of a mean speed [km/h] or of a flow [veh/h].
        met: Steps in which a vehicle is met, and the epsilon of the density releases alone.
        alone: The same with the speeds: epsilon of both releases for a vehicle that is alone on its
            segment and stands.
        void_reasons: Why nothing may be claimed; empty where something may.
    """

    claimed: float
    composed: float
    density_std: float
    second_std: float
    met: dict[int, float]
    alone: dict[int, float]
    void_reasons: tuple[str, ...]


def mu_met(config: EnvConfig, density_std: float, contributions: int) -> float:
    """Return mu of the density releases alone for a vehicle that is met so many times.

    A lower bound on that of the whole transcript: what is released of speeds only adds to it. It
    is reached by two records in which one vehicle's trip is replaced by another one elsewhere, each
    met `contributions` times.

    Args:
        config: Gives the segment length and the largest speed.
        density_std: Noise of a density [veh/km].
        contributions: Steps in which the vehicle is met.
    """
    sensitivity = contribution_sensitivity(
        contributions=contributions,
        adjacency="replace",
        segment_length=config.corridor.segment_length,
        largest_speed=config.corridor.speed_limit,
        protects="one vehicle's trip, replaced by another",
    )
    return sensitivity.releases[0].bound / density_std


def mu_alone(
    config: EnvConfig, density_std: float, mean_speed_std: float, contributions: int
) -> float:
    """Return mu of densities and mean speeds for a vehicle that is alone where it is met.

    It stands, and an empty segment answers with the speed limit, so its mean speed moves by the
    limit. In either world `contributions` segments differ.
    """
    speed = math.sqrt(2.0 * contributions) * config.corridor.speed_limit / mean_speed_std
    return math.hypot(mu_met(config, density_std, contributions), speed)


def account_of(env: str, cell: Cell, seeds: Sequence[int], contributions: Sequence[int]) -> Account:
    """Return what the noise of a cell is worth.

    Args:
        env: Environment id.
        cell: The cell.
        seeds: Traffic seeds that the environment is made with; the account depends on none.
        contributions: Steps in which a vehicle may be met.
    """
    config: EnvConfig = make_env(env, cell, seeds, None).unwrapped.config  # type: ignore[attr-defined]
    report = config.accountant().report
    density_std, second_std = (release.noise_std for release in report.releases)
    # Where contributions are bounded, no vehicle counts more often, and the bound is met exactly.
    bounded = config.privacy.is_bounded
    most = config.privacy.contributions(config.horizon_steps) if bounded else config.horizon_steps
    counted = {n: min(n, most) for n in contributions}

    def epsilon(mu: float) -> float:
        return epsilon_of(mu, config.privacy.delta)

    def alone(n: int) -> float:
        if bounded:
            return epsilon(report.mu * math.sqrt(n / most))
        return epsilon(mu_alone(config, density_std, second_std, n))

    return Account(
        claimed=cell.epsilon,
        composed=report.epsilon,
        density_std=density_std,
        second_std=second_std,
        met={n: epsilon(mu_met(config, density_std, own)) for n, own in counted.items()},
        alone={n: alone(own) for n, own in counted.items()},
        void_reasons=report.void_reasons,
    )


def trip_lengths(
    corridor: Corridor, seeds: Sequence[int], records: str | Path | None
) -> NDArray[np.int64]:
    """Return how long each vehicle of the records can be met, pooled over the seeds [s].

    That is the number of seconds that it is on a segment which can be queried. Vehicles that still
    drive when a record ends count with what was recorded. Truth: for evaluation only.
    """
    library = RecordLibrary(records)
    lengths = []
    for seed in seeds:
        record = library.get(corridor, seed)
        mainline = record.segment < corridor.n_mainline
        seconds = np.bincount(record.vehicle[mainline], minlength=record.n_vehicles)
        lengths.append(seconds[seconds > 0])
    return np.concatenate(lengths).astype(np.int64)
