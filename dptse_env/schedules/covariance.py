"""Schedules that use the estimator's covariance, which is public, unlike the truth."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, Protocol, cast

import numpy as np

from dptse_env.estimators.settings import Deviation
from dptse_env.process import QueryProcess
from dptse_env.schedules import greedy_kernels as kernels
from dptse_env.schedules.base import ProcessSchedule, require_plain
from dptse_env.schedules.covariance_kernels import Problem
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.fields import POSITIVE, checked_fields


@dataclass(frozen=True)
class CovarianceInflation:
    """Inflation of the covariance that a schedule uses, and weights of its variances.

    Attributes:
        process_noise: Standard deviations of the process noise of a step, of rho over rho_m and of
            psi over rho_m v_f, with which the schedule propagates a separate covariance, starting
            from the estimator's prior. None for the estimator's present covariance and settings.
        occupied: Whether the variance of a speed is weighted by the probability that the segment
            has a vehicle, 1 - exp(-rho l); an empty segment has no speed error.
        speed_cap: Standard deviation of a speed, in the reward's scale, beyond which it does not
            count.

    Raises:
        ValueError: A value is out of range.
    """

    process_noise: tuple[Deviation, Deviation] | None = None
    occupied: bool = False
    speed_cap: Annotated[float, POSITIVE] | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "inflation")


NO_INFLATION = CovarianceInflation()
"""The estimator's covariance as it is."""

INFLATED = CovarianceInflation(process_noise=(0.1, 0.03), occupied=True, speed_cap=0.1)
"""Selected on validation traffic among inflations that differ from it by factors of three."""


class HasCovariance(Protocol):
    """An estimator with a covariance."""

    @property
    def states(self) -> FloatArray:
        """Means, shape (n, 2 S) [veh/km, veh/h], or with demand factors at their end."""

    @property
    def covariances(self) -> FloatArray:
        """Those of the means, rho normalised by rho_m and psi by rho_m v_f."""


class CovarianceSchedule(ProcessSchedule):
    """A schedule that predicts a covariance one step ahead.

    The prediction is that of the EKF, x = f(x, u), P = F P F' + Q at the present estimate, with the
    inputs that the estimator will be given. For other estimators with a model it linearises their
    prediction; for a random walk it adds the walk's variance to each segment. Releases and
    traffic are linearised at the predicted mean.
    """

    name: ClassVar[str]

    def __init__(
        self,
        process: QueryProcess,
        seed: int | None = None,
        *,
        inflation: CovarianceInflation = INFLATED,
    ) -> None:
        """Bind the schedule to a process (``env.unwrapped.process``).

        Raises:
            ValueError: The estimator has no covariance, or options are not the mainline segments.
        """
        super().__init__(process, seed)
        require_plain(process.interface, self.name)
        if not hasattr(type(process.estimator), "covariances"):
            raise ValueError(
                f"schedule {self.name!r} needs an estimator with a covariance, "
                f"{process.config.estimator!r} has none"
            )
        self.inflation = inflation
        self._estimator = cast(HasCovariance, process.estimator)
        self._road = tuple(process.model.road)
        self._problem = tuple(_problem(process, inflation))
        self._n_traffic = 2 * process.model.n_segments
        self._covariances: FloatArray = self._traffic_covariances
        self._after = self._covariances.copy()
        self._second = np.full(process.n_episodes, -1)

    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        process = self.process
        inputs = process.boundary.inputs(rows, process.traffic_index[rows], process.time[rows])
        means, covariances = self._estimator.states[rows, : self._n_traffic], self._present(rows)
        queried = np.empty((len(rows), self.n_mainline), dtype=bool)
        self._select(means, covariances, np.ascontiguousarray(inputs), queried)
        if self.inflation.process_noise is not None:
            self._after[rows] = covariances
        return queried

    @abstractmethod
    def _select(
        self, means: FloatArray, covariances: FloatArray, inputs: FloatArray, queried: BoolArray
    ) -> None:
        """Write the sets to ``queried`` (k, n_mainline), posterior ones to ``covariances``."""

    @property
    def _traffic_covariances(self) -> FloatArray:
        """The estimator's covariances without demand states, shape (n, 2 S, 2 S)."""
        n = self._n_traffic
        return np.ascontiguousarray(self._estimator.covariances[:, :n, :n])

    def _present(self, rows: IntArray) -> FloatArray:
        """Return present covariances, shape (k, 2 S, 2 S): the estimator's, or inflated ones."""
        if self.inflation.process_noise is None:
            covariances = self._traffic_covariances
            return covariances if len(rows) == len(covariances) else covariances[rows]
        # A repeated call in the same second starts from the same covariance; after a second
        # without a call, as after a reset, the estimator's is the start.
        second = self.process.elapsed[rows]
        missed = (second == 0) | (second > self._second[rows] + 1) | (second < self._second[rows])
        moved = second == self._second[rows] + 1
        self._covariances[rows[moved]] = self._after[rows[moved]]
        if missed.any():
            self._covariances[rows[missed]] = self._traffic_covariances[rows[missed]]
        self._second[rows] = second
        inflated: FloatArray = self._covariances[rows]
        return inflated


class GreedyTrace(CovarianceSchedule):
    """Greedy design: segments are chosen in turn, each the most informative given those before.

    C is the predicted covariance of density and speed over the mainline, in the reward's units,
    after an update by the fixed sensors. A query of segment s, with its two rows H_s and the noise
    R, reduces C by ``C H_s' (H_s C H_s' + R)^-1 H_s C``. The most informative segment
    has the largest trace of that reduction, weighted as in `CovarianceInflation`. The full trace is
    the squared error that the estimator expects in the reward's metric.

    By default the covariance is inflated (`INFLATED`): an estimator that is overconfident about
    segments without recent measurements keeps its errors there. The larger process noise lets
    variances grow within seconds; the cap limits the weight of the speeds of nearly empty segments.

    The cost is a rank-2 downdate of C per pick, O(B n^2), after a prediction that costs as much as
    the EKF's: about 1.5 EKF steps at n = 15, B = 5.
    """

    name: ClassVar[str] = "greedy-trace"

    def _select(
        self, means: FloatArray, covariances: FloatArray, inputs: FloatArray, queried: BoolArray
    ) -> None:
        keeps = self.inflation.process_noise is not None
        kernels.choose_greedily(
            self._road, self._problem, keeps, means, covariances, inputs, queried
        )


def _problem(process: QueryProcess, inflation: CovarianceInflation) -> Problem:
    config, model = process.config, process.model
    corridor, settings, term = config.corridor, config.settings(), process.interface.reward.term
    n, rho_m, v_f = corridor.n_mainline, model.density_scale, model.speed_scale
    sigma = np.array(settings.noise_scale) * process.expected_sigma / model.measurement_scale
    is_walk = config.estimator == "random_walk"
    noise = settings.walk_noise if is_walk else settings.process_noise
    always = np.array(sorted(corridor.fixed_sensors), dtype=np.int64)
    return Problem(
        n_mainline=n,
        bandwidth=config.bandwidth,
        always=always,
        can_query=np.setdiff1d(np.arange(n), always),
        noise=sigma**2,
        centre=np.nan if model.reference_speed is None else model.reference_speed,
        process_variance=np.tile(np.square(inflation.process_noise or noise), model.n_segments),
        is_walk=is_walk,
        is_box=settings.bounds == "box",
        density_scale=float(rho_m),
        units=np.array([corridor.density_scale / rho_m, corridor.speed_scale / v_f]),
        term_weights=np.array([term != "speed", term != "density"], dtype=np.float64),
        lengths=np.array(corridor.segment_lengths[:n]) if inflation.occupied else np.zeros(0),
        speed_cap=np.inf if inflation.speed_cap is None else inflation.speed_cap,
    )
