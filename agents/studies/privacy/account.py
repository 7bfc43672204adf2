"""Guarantees behind noise: epsilon as claimed, as composed, and as met by one vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.environments import make_config, quietly
from agents.studies.privacy.plan import PrivacyCell, PrivacyDesign
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.privacy import contribution_sensitivity, epsilon_of
from dptse_env.release import CappedSettings
from dptse_env.traffic import Corridor, RecordLibrary, with_vehicles
from dptse_env.utils.arrays import IntArray


@dataclass(frozen=True)
class Account:
    """The guarantee that a configuration's noise gives.

    Attributes:
        claimed: The epsilon of the configuration.
        composed: Epsilon of both releases together, if the preset's sensitivities held.
        density_std: Noise of a density [veh/km].
        second_std: Noise of a mean speed [km/h] or of a flow [veh/h].
        met: By the number of steps in which a vehicle is met, epsilon of the density releases.
        alone: The same with the speeds: epsilon of both releases for a vehicle that stands and is
            alone on its segment.
        void_reasons: Reasons why no guarantee holds; empty where one does.
    """

    claimed: float
    composed: float
    density_std: float
    second_std: float
    met: dict[int, float]
    alone: dict[int, float]
    void_reasons: tuple[str, ...]


def mu_met(config: EnvConfig, density_std: float, contributions: int) -> float:
    """Return mu of the density releases [veh/km] alone for a vehicle that is met in some steps.

    A lower bound on mu of the whole transcript, since releases of speeds only add to it. It is
    reached by two records in which one vehicle's trip is replaced by a trip elsewhere, each met
    `contributions` times.
    """
    sensitivity = contribution_sensitivity(
        contributions=contributions,
        adjacency="replace",
        segment_length=min(config.corridor.segment_lengths),
        largest_speed=config.corridor.largest_speed_limit,
    )
    return sensitivity.releases[0].bound / density_std


def mu_alone(
    config: EnvConfig, density_std: float, mean_speed_std: float, contributions: int
) -> float:
    """Return mu of densities and mean speeds for a vehicle that is alone where it is met.

    The vehicle stands, and an empty segment releases the speed limit, so the mean speed moves by
    the limit. In either record `contributions` segments differ.
    """
    speed = math.sqrt(2.0 * contributions) * config.corridor.largest_speed_limit / mean_speed_std
    return math.hypot(mu_met(config, density_std, contributions), speed)


def make_account(design: PrivacyDesign, cell: PrivacyCell, contributions: Sequence[int]) -> Account:
    """Return the guarantee behind a cell's noise, by numbers of steps in which a vehicle is met."""
    with quietly():
        config = make_config(design.env, design.keywords(cell))
    report, privacy = privacy_report(config), config.privacy
    density_std, second_std = (release.noise_std for release in report.releases)
    # Where contributions are bounded, no vehicle counts more often, and the bound is met exactly.
    bounded, most = isinstance(privacy, CappedSettings), config.horizon_steps
    if isinstance(privacy, CappedSettings):
        most = privacy.contributions(most)
    counted = {n: min(n, most) for n in contributions}

    def met(n: int) -> float:
        return epsilon_of(mu_met(config, density_std, n), privacy.delta)

    def alone(n: int) -> float:
        if bounded:
            mu = report.mu * math.sqrt(n / most)
        else:
            mu = mu_alone(config, density_std, second_std, n)
        return epsilon_of(mu, privacy.delta)

    return Account(
        claimed=cell.epsilon,
        composed=report.epsilon,
        density_std=density_std,
        second_std=second_std,
        met={n: met(count) for n, count in counted.items()},
        alone={n: alone(count) for n, count in counted.items()},
        void_reasons=report.void_reasons,
    )


@dataclass(frozen=True)
class Traffic:
    """The traffic of a corridor, whatever the seed."""

    corridor: str


@dataclass(frozen=True)
class Trips:
    """The lengths of all trips of a record.

    Attributes:
        traffic_seed: The traffic.
        seconds: Seconds that each vehicle is on a segment which can be queried, numbers with
            spaces between them. Vehicles that still drive when the record ends count with what was
            recorded.
    """

    traffic_seed: int
    seconds: str

    @property
    def lengths(self) -> IntArray:
        """The seconds as an array, shape (n_vehicles,)."""
        return np.array(self.seconds.split(), dtype=np.int64)


def measure_trips(corridor: Corridor, seed: int, library: RecordLibrary) -> Trips:
    """Return the lengths of the trips of a record; truth, for evaluation only."""
    record = with_vehicles(library.get(corridor, seed), "the account")
    mainline = record.segment < corridor.n_mainline
    seconds = np.bincount(record.vehicle[mainline], minlength=record.n_vehicles)
    return Trips(seed, " ".join(map(str, seconds[seconds > 0].tolist())))
