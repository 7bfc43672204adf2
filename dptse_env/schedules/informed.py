"""Schedules that know the estimator's covariance: the operator's own knowledge, not the truth."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol, cast

import numpy as np

from dptse_env.model.road_arrays import road_of
from dptse_env.process import QueryProcess
from dptse_env.schedules import greedy_kernels as kernels
from dptse_env.schedules.base import BoundSchedule
from dptse_env.schedules.covariance_kernels import Problem
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.validation import non_negative, positive, sequence


@dataclass(frozen=True)
class Caution:
    """How far a schedule trusts the estimator's covariance.

    Attributes:
        process_noise: Standard deviations of what the model misses in a step, of rho over rho_m and
            of psi over rho_m v_f. With them the schedule keeps a covariance of its own, begun with
            the estimator's prior. None takes the estimator's present covariance and settings.
        occupied: Whether the variance of a speed weighs as probably as the segment has a vehicle,
            1 - exp(-rho l); a segment without one has no speed to be wrong about.
        speed_cap: Deviation of a speed, in the reward's scale, beyond which it does not count.

    Raises:
        ValueError: A value is out of range.
    """

    process_noise: tuple[float, float] | None = None
    occupied: bool = False
    speed_cap: float | None = None

    def __post_init__(self) -> None:
        """Check values."""
        if self.process_noise is not None:
            pair = sequence("caution.process_noise", self.process_noise, length=2)
            for i, value in enumerate(pair):
                non_negative(f"caution.process_noise[{i}]", value)
        if self.speed_cap is not None:
            positive("caution.speed_cap", self.speed_cap)


TRUSTING = Caution()
"""The estimator's covariance as it is."""

WARY = Caution(process_noise=(0.1, 0.03), occupied=True, speed_cap=0.1)
"""Chosen on validation traffic among those that differ from it by factors of three."""


class WithCovariance(Protocol):
    """What the schedules need of an estimator."""

    @property
    def states(self) -> FloatArray:
        """Means, shape (n, 2 S) [veh/km, veh/h]."""

    @property
    def covariances(self) -> FloatArray:
        """Shape (n, 2 S, 2 S), rho normalised by rho_m and psi by rho_m v_f."""


class Informed(BoundSchedule):
    """A schedule that predicts a covariance one step ahead.

    The prediction is x = f(x, u), P = F P F' + Q at the present estimate, with the inputs that the
    estimator will be given: the EKF's own. For other estimators with a model it is a
    linearisation of theirs; a random walk adds its own variance and leaves segments as they are.
    Releases and traffic are linearised at the predicted mean.
    """

    name: ClassVar[str]

    def __init__(
        self, process: QueryProcess, seed: int | None = None, *, caution: Caution = TRUSTING
    ) -> None:
        """Bind the schedule.

        Args:
            process: The process (``env.unwrapped.process``).
            seed: Unused; nothing is drawn.
            caution: How far the covariance is trusted.

        Raises:
            ValueError: The estimator has no covariance.
        """
        super().__init__(process, seed)
        if not hasattr(type(process.estimator), "covariances"):
            raise ValueError(
                f"schedule {self.name!r} needs an estimator with a covariance, "
                f"{process.config.estimator!r} has none"
            )
        self.caution = caution
        self._estimator = cast(WithCovariance, process.estimator)
        self._road = tuple(road_of(process.model))
        self._problem = tuple(_problem(process, caution))
        self._covariances: FloatArray = self._estimator.covariances
        self._after = self._covariances.copy()
        self._second = np.full(process.n_episodes, -1)

    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        process = self.process
        inputs = process.boundary.inputs(rows, process.traffic_index[rows], process.time[rows])
        means, covariances = self._estimator.states[rows], self._present(rows)
        queried = np.empty((len(rows), self.n_mainline), dtype=bool)
        self._select(means, covariances, np.ascontiguousarray(inputs), queried)
        if self.caution.process_noise is not None:
            self._after[rows] = covariances
        return queried

    @abstractmethod
    def _select(
        self, means: FloatArray, covariances: FloatArray, inputs: FloatArray, queried: BoolArray
    ) -> None:
        """Write the sets to ``queried`` (k, n_mainline), what is left to ``covariances``."""

    def _present(self, rows: IntArray) -> FloatArray:
        """Return present covariances, shape (k, 2 S, 2 S): the estimator's, or its own."""
        if self.caution.process_noise is None:
            theirs: FloatArray = self._estimator.covariances
            return theirs if len(rows) == len(theirs) else theirs[rows]
        # Asked again in the same second, it begins where it began before; after a second without
        # being asked, as after a reset, it begins anew with the estimator's.
        second = self.process.elapsed[rows]
        missed = (second == 0) | (second > self._second[rows] + 1) | (second < self._second[rows])
        moved = second == self._second[rows] + 1
        self._covariances[rows[moved]] = self._after[rows[moved]]
        if missed.any():
            self._covariances[rows[missed]] = self._estimator.covariances[rows[missed]]
        self._second[rows] = second
        own: FloatArray = self._covariances[rows]
        return own


class Greedy(Informed):
    """Segments one after the other, each the one whose release tells most given those before.

    C is the covariance of density and speed over the mainline, in the reward's units, that the
    fixed sensors leave of the prediction. Asking segment s, H_s its two rows and R the noise, takes
    ``C H_s' (H_s C H_s' + R)^-1 H_s C`` from C. Criteria:

    - ``trace`` (A-optimal): the trace of that, weighted as `Caution` says. The full trace is the
      squared error that the estimator expects in the reward's metric.
    - ``logdet`` (D-optimal): ``log det(H_s C H_s' + R) - log det R``, what the log determinant of
      the whole state's covariance loses. It is the same in all units, so it knows nothing of the
      reward. The gain is submodular: greedy reaches 63 % of the best set's.

    One rank-2 downdate of C a pick, O(B n^2), after a prediction of the cost of the EKF's own.
    About 1.2 EKF steps in all at n = 15, B = 5, with a covariance of its own about 1.5.
    """

    criterion: ClassVar[int]

    def _select(
        self, means: FloatArray, covariances: FloatArray, inputs: FloatArray, queried: BoolArray
    ) -> None:
        keeps = self.caution.process_noise is not None
        kernels.choose_greedily(
            self._road, self._problem, self.criterion, keeps, means, covariances, inputs, queried
        )


class GreedyTrace(Greedy):
    """`Greedy` by the trace (A-optimal)."""

    name: ClassVar[str] = "greedy-trace"
    criterion: ClassVar[int] = kernels.TRACE


class GreedyLogdet(Greedy):
    """`Greedy` by the log determinant (D-optimal)."""

    name: ClassVar[str] = "greedy-logdet"
    criterion: ClassVar[int] = kernels.LOGDET


class WaryTrace(GreedyTrace):
    """`GreedyTrace` that trusts no covariance: `WARY`, unless told otherwise.

    An estimator that is sure of what it has not seen for long leaves its errors there. The larger
    process noise lets variances grow back within seconds, the cap keeps the speeds of nearly empty
    segments from outweighing all else.
    """

    name: ClassVar[str] = "wary-trace"

    def __init__(
        self, process: QueryProcess, seed: int | None = None, *, caution: Caution = WARY
    ) -> None:
        """See `Informed`."""
        super().__init__(process, seed, caution=caution)


def _problem(process: QueryProcess, caution: Caution) -> Problem:
    config, model = process.config, process.model
    corridor, settings, term = config.corridor, config.settings(), process.interface.reward.term
    n, rho_m, v_f = corridor.n_mainline, model.density_scale, model.speed_scale
    sigma = settings.noise_scale * process.release.sigma / model.measurement_scale
    is_walk = config.estimator == "random_walk"
    noise = settings.walk_noise if is_walk else settings.process_noise
    always = np.array(sorted(corridor.fixed_sensors), dtype=np.int64)
    return Problem(
        n_mainline=n,
        bandwidth=config.bandwidth,
        always=always,
        askable=np.setdiff1d(np.arange(n), always),
        noise=sigma**2,
        process_variance=np.square(caution.process_noise or noise, dtype=np.float64),
        is_walk=is_walk,
        is_box=settings.bounds == "box",
        density_scale=float(rho_m),
        units=np.array([corridor.density_scale / rho_m, corridor.speed_scale / v_f]),
        term_weights=np.array([term != "speed", term != "density"], dtype=np.float64),
        length=corridor.segment_length if caution.occupied else 0.0,
        speed_cap=np.inf if caution.speed_cap is None else caution.speed_cap,
    )
