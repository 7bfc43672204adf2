"""Release models with Gaussian noise: `Paper`, `Corrected` and `Capped`."""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.privacy import (
    ReleaseAccount,
    Sensitivity,
    contribution_sensitivity,
    epsilon_of,
    joint_noise_std,
    paper_sensitivity,
    printed_noise_std,
    single_noise_std,
)
from dptse_env.release.base import ReleaseModel, ReleaseRequest, ReleaseSetup
from dptse_env.release.contributions import Contributions
from dptse_env.release.mechanism import GaussianMechanism, Mechanism
from dptse_env.release.noise import NoiseStreams
from dptse_env.release.report import STRICT_DELTA, PrivacyReport, QuantityReport, in_order
from dptse_env.release.settings import CappedSettings, PrivacySettings
from dptse_env.traffic import Corridor, Record
from dptse_env.utils.arrays import AnyArray, FloatArray, IntArray
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.vector_info import Rows, object_array


class GaussianRelease(ReleaseModel):
    """Release of true values plus Gaussian noise; subclasses define values and sensitivity.

    Sensitivity and noise are those of the shortest segment. One vehicle changes the sums of a
    longer one by less, in proportion to its length, and its noise is smaller by as much: a vehicle
    counts alike on every segment, in units of the noise.

    Attributes:
        sensitivity: L2 sensitivities of both released quantities over an episode.
    """

    takes_noise: bool = True

    def __init__(self, setup: ReleaseSetup) -> None:
        """Compute sensitivity and noise; nothing is loaded."""
        super().__init__(setup)
        self.sensitivity = self._sensitivity()
        stretch = setup.lengths / min(setup.corridor.segment_lengths)
        self._stretch = None if (stretch == 1.0).all() else stretch[:, None]
        self.mechanism = GaussianMechanism(
            self._noise_std(), n_episodes=setup.n_episodes, n_segments=setup.n_columns
        )

    @property
    def mechanism(self) -> Mechanism:
        """The mechanism that adds the noise; account and report describe it."""
        return self._mechanism

    @mechanism.setter
    def mechanism(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        mu = self.sensitivity.joint_mu(mechanism.sigma.tolist())
        contributions = self.sensitivity.contributions
        self._account = ReleaseAccount(mu, self.setup.settings.delta, contributions)

    def give_noise(self, noise: FloatArray) -> None:
        """See `ReleaseModel.give_noise`."""
        if not isinstance(self.mechanism, NoiseStreams):
            raise ValueError(f"noise of {name_of_class(type(self.mechanism))} cannot be set")
        self.mechanism.give(noise)

    @abstractmethod
    def _sensitivity(self) -> Sensitivity:
        """Return the sensitivities of both released quantities."""

    @abstractmethod
    def _noise_std(self) -> tuple[float, ...]:
        """Return the standard deviations of the noise that `sensitivity` needs."""

    @abstractmethod
    def _void_reasons(self) -> tuple[str, ...]:
        """Return the reasons for which the sensitivity or the noise gives no guarantee."""

    @abstractmethod
    def true_values(self, request: ReleaseRequest) -> FloatArray:
        """Return what is released before noise is added, shape (k, n_columns, 2).

        Where contributions are bounded, those of the observed columns are charged.
        """

    @property
    def protects(self) -> str:
        """Description of the protected data and of the change that is protected."""
        return "one vehicle's trip, replaced by another"

    @property
    def sigma(self) -> FloatArray:
        """See `ReleaseModel.sigma`."""
        return self.mechanism.sigma

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`."""
        self.mechanism.reset(episodes, generators)

    def release(self, request: ReleaseRequest) -> Measurement:
        """See `ReleaseModel.release`."""
        values = self.true_values(request)
        if self._stretch is None:
            released = self.mechanism.release(request.episodes, values)
            return self.measurement(request, released, self.sigma)
        values = self.mechanism.release(request.episodes, values * self._stretch) / self._stretch
        return self.measurement(request, values, self.sigma / self._stretch)

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `ReleaseModel.spent`."""
        return self._account.spent(steps)

    def report(self) -> PrivacyReport:
        """See `ReleaseModel.report`; it describes the noise in force."""
        settings, sensitivity = self.setup.settings, self.sensitivity
        stds, mu = self.sigma.tolist(), self._account.mu
        epsilon = epsilon_of(mu, settings.delta)
        found = list(self._void_reasons())
        # Le Ny's kappa may be so loose that even both releases together stay below epsilon.
        if epsilon > settings.epsilon * (1.0 + 1e-9):
            found.append("releases_not_composed")
        return replace(
            super().report(),
            guarantee="none" if found else self._guarantee(),
            void_reasons=in_order(found),
            protects=self.protects,
            mu=mu,
            epsilon=epsilon,
            epsilon_strict=epsilon_of(mu, STRICT_DELTA),
            releases=tuple(
                QuantityReport(item.quantity, item.unit, item.bound, std, item.bound / std)
                for item, std in zip(sensitivity.releases, stds, strict=True)
            ),
            assumptions=dict(sensitivity.assumptions),
            details=self._details(),
        )

    def _details(self) -> Mapping[str, Any]:
        """Return the settings specific to this model, for the report; none of them is None."""
        return {"adjacency": "replace"}

    def _guarantee(self) -> str:
        quantities = " and ".join(release.quantity for release in self.sensitivity.releases)
        return self.setup.settings.guarantee(quantities, self.protects)


def require_gaussian(release: ReleaseModel, user: str) -> GaussianRelease:
    """Return a release model with Gaussian noise; ``user`` names in errors what needs one.

    Raises:
        ValueError: It is another release model.
    """
    if not isinstance(release, GaussianRelease):
        raise ValueError(
            f"{user} needs a release model with Gaussian noise, got {release.setup.name!r}"
        )
    return release


class Paper(GaussianRelease):
    """True density and mean speed of all vehicles, with the noise as printed in the paper."""

    def __init__(self, setup: ReleaseSetup) -> None:
        """See `GaussianRelease`."""
        super().__init__(setup)
        self._in_order = np.array_equal(setup.places, np.arange(setup.n_places))

    def _sensitivity(self) -> Sensitivity:
        setup, corridor = self.setup, self.setup.corridor
        return paper_sensitivity(
            n_sensors=setup.bandwidth + len(setup.always_observed),
            average_dwell=corridor.average_dwell,
            segment_length=min(corridor.segment_lengths),
            # Constants of the corridor, so that the noise does not depend on the estimator.
            free_flow_speed=corridor.speed_scale,
            jam_density=corridor.density_scale,
        )

    def _noise_std(self) -> tuple[float, ...]:
        settings = self.setup.settings
        return printed_noise_std(self.sensitivity, settings.epsilon, settings.delta)

    def _void_reasons(self) -> tuple[str, ...]:
        return ("literal_variance", "average_dwell", "adaptive_queries", "speed_sensitivity")

    def true_values(self, request: ReleaseRequest) -> FloatArray:
        """See `GaussianRelease.true_values`."""
        setup = self.setup
        values = setup.traffic.aggregates(request.traffic, request.times, setup.n_places)
        return values if self._in_order else values[:, setup.places]


class Corrected(Paper):
    """The same as `Paper`, with the noise that the theorem cited there needs, per release."""

    def _noise_std(self) -> tuple[float, ...]:
        settings = self.setup.settings
        return single_noise_std(self.sensitivity, settings.epsilon, settings.delta)

    def _void_reasons(self) -> tuple[str, ...]:
        return super()._void_reasons()[1:]


class Capped(GaussianRelease):
    """Density and centred flow of vehicles that count a bounded number of times.

    The guarantee holds for any query policy. The centred flow [veh/h] is the sum of v - v_0 over
    the vehicles that count, per length, with v clipped to [0, 2 v_0]: it changes by at most v_0 / l
    when a vehicle comes or goes. ``docs/privacy.md`` has the proof.
    """

    settings_type: ClassVar[type[PrivacySettings]] = CappedSettings
    claims_guarantee: ClassVar[bool] = True
    needs_vehicles: ClassVar[bool] = True

    @classmethod
    def flow_centre(cls, corridor: Corridor, settings: CappedSettings) -> float | None:
        """Return half of the largest speed limit, the centre of the speeds clipped to it."""
        return 0.5 * corridor.largest_speed_limit if settings.speed_release == "flow" else None

    def __init__(self, setup: ReleaseSetup) -> None:
        """See `GaussianRelease`; the vehicle tables are empty until `load`."""
        assert isinstance(setup.settings, CappedSettings)
        self._settings = setup.settings
        super().__init__(setup)
        corridor, traffic = setup.corridor, setup.traffic
        self.contributions = Contributions(
            len(traffic.traffic_seeds),
            corridor.duration + 1,
            setup.n_episodes,
            corridor.largest_speed_limit,
            setup.settings.contribution_cap,
            setup.places,
        )

    def _sensitivity(self) -> Sensitivity:
        corridor, settings = self.setup.corridor, self._settings
        slope = corridor.speed_scale / corridor.density_scale
        return contribution_sensitivity(
            contributions=settings.contributions(self.setup.horizon),
            adjacency=settings.adjacency,
            segment_length=min(corridor.segment_lengths),
            largest_speed=corridor.largest_speed_limit,
            mean_speed_slope=slope if settings.speed_release == "mean" else None,
        )

    def _noise_std(self) -> tuple[float, ...]:
        settings = self._settings
        noise = joint_noise_std(self.sensitivity, settings.epsilon, settings.delta, settings.share)
        return tuple(std / math.sqrt(self.setup.budget_share) for std in noise)

    def _void_reasons(self) -> tuple[str, ...]:
        return ("speed_sensitivity",) if self._settings.speed_release == "mean" else ()

    @property
    def protects(self) -> str:
        """See `GaussianRelease.protects`."""
        return self._settings.protected

    def _details(self) -> Mapping[str, Any]:
        settings = self._settings
        cap = {"cap": settings.cap} if settings.unit == "trip" else {}
        return {
            "unit": settings.unit, **cap, "adjacency": settings.adjacency, "share": settings.share,
        }  # fmt: skip

    @property
    def shared(self) -> tuple[AnyArray, ...]:
        """The vehicles of all traffic."""
        return self.contributions.vehicles.arrays

    def load(self, index: int, record: Record) -> None:
        """Read the vehicle table of a record."""
        user = f"the release model {self.setup.name!r}"
        self.contributions.load(index, record.vehicles_for(user))

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`; no vehicle has counted yet."""
        super().reset(episodes, generators)
        self.contributions.reset(episodes)

    def true_values(self, request: ReleaseRequest) -> FloatArray:
        """See `GaussianRelease.true_values`; unobserved columns hold zeros."""
        setup, corridor = self.setup, self.setup.corridor
        counts, speeds = self.contributions.collect(
            request.episodes, request.traffic, request.times, request.observed
        )
        values = np.empty((*counts.shape, 2))
        np.divide(counts, setup.lengths, out=values[..., 0])
        if self._settings.speed_release == "flow":
            speeds -= 0.5 * corridor.largest_speed_limit * counts
            np.divide(speeds, setup.lengths, out=values[..., 1])
        else:
            empty, limits = counts == 0.0, setup.traffic.limits[setup.places]
            values[..., 1] = np.where(empty, limits, speeds / np.where(empty, 1.0, counts))
        return values

    def budgets_spent(self, episodes: IntArray) -> FloatArray:
        """See `ReleaseModel.budgets_spent`: contributions over their cap."""
        spent: FloatArray = self.contributions.exposures[episodes].sum(axis=1, dtype=np.float64)
        return spent / self.contributions.cap if self.contributions.cap else np.zeros_like(spent)

    def private_info(self, episodes: IntArray, traffic: IntArray) -> Rows:
        """Return each vehicle's contributions and the epsilon that it has spent.

        Lists, since records differ in their number of vehicles and Gymnasium stacks arrays of equal
        shape only.
        """
        counted = [
            self.contributions.exposures_of(episode, index)
            for episode, index in zip(episodes, traffic, strict=True)
        ]
        # A vehicle that has counted k times has spent the budget of a cap of k.
        spent = [self._account.spent(steps.astype(np.int64))[1].tolist() for steps in counted]
        return {
            "exposures": object_array([steps.tolist() for steps in counted]),
            "individual_epsilon": object_array(spent),
        }
