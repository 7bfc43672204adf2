"""Settings of the estimators: frozen dataclasses, checked when they are made.

They are in one file: those of all filters are fields of `EstimatorSettings`, which every filter
takes, and a configuration checks them before it imports any.
"""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from dptse_env.model import Bounds
from dptse_env.utils.validation import Interval, checked_fields

Linearisation = Literal["published", "trajectory"]

PATH = "estimator_settings"
"""Their place in error messages."""

Deviation = Annotated[float, Interval(0, 10)]
"""A standard deviation in units of rho_m or v_f."""
NoiseScale = Annotated[float, Interval(1e-6, 1000)]
"""A factor on a standard deviation of the mechanism's noise."""
ArrivalDeviation = Annotated[float, Interval(1e-6, 10)]
"""A positive standard deviation in units of rho_m or v_f."""


class _Checked:
    """Base class of settings, whose fields are checked when they are made.

    Raises:
        ValueError: A value is out of range.
    """

    _path: ClassVar[str]

    def __init_subclass__(cls, path: str) -> None:
        """Set the path of the settings in error messages."""
        cls._path = path

    def __post_init__(self) -> None:
        """Check values; lists become tuples."""
        checked_fields(self, self._path)


@dataclass(frozen=True)
class SigmaPointSettings(_Checked, path=f"{PATH}.ukf"):
    """Sigma points of the unscented Kalman filter (van der Merwe, 2004), with the paper's values.

    Attributes:
        alpha: Spread of the points.
        beta: Weight of the first point in covariances; 2 suits normal distributions.
        kappa: Secondary spread; above minus the number of states.
    """

    alpha: Annotated[float, Interval(1e-3, 1)] = 0.1
    beta: Annotated[float, Interval(0, 100)] = 2.0
    kappa: Annotated[float, Interval(-10_000, 10_000)] = -4.0


@dataclass(frozen=True)
class EnsembleSettings(_Checked, path=f"{PATH}.enkf"):
    """Settings of the ensemble Kalman filter beside `EstimatorSettings`.

    Attributes:
        n_members: Members of an ensemble.
        inflation: Factor on the members' distances from their mean ahead of every update
            (Anderson and Anderson, 1999); 1 has no effect.
        taper: Distance along the road [km] from which a measurement does not affect a state
            (Gaspari and Cohn, 1999); None for no limit.
    """

    n_members: Annotated[int, Interval(2, 10_000)] = 100
    inflation: Annotated[float, Interval(1, 10)] = 1.0
    taper: Annotated[float, Interval(0, 1e6, open_low=True)] | None = None


@dataclass(frozen=True)
class HorizonSettings(_Checked, path=f"{PATH}.mhe"):
    """Settings of the moving horizon estimator beside `EstimatorSettings`.

    The weights of the paper's objective (eq. 14) are inverse variances, so that H is the inverse
    covariance of the window: mu of `arrival_noise`, w_1 of the measurements' known noise and w_2
    of `EstimatorSettings.process_noise`. While the window grows its arrival is the prior, of
    `EstimatorSettings.initial_variance`.

    Attributes:
        horizon: N, length of the window in steps; N + 1 times the number of states is at most
            3,000.
        arrival_noise: Standard deviations of the predicted state at the window's start, of rho
            over rho_m and psi over rho_m v_f.
        linearisation: `published`: each stage once, when it enters the window, at the mean of the
            last solution; `trajectory`: all stages at every step along the last solution.
        bounds: `box`, the paper's, or `cone`: the smallest box around the cone of physical states
            bounds the program, and its last state is projected into the cone.
    """

    horizon: Annotated[int, Interval(1, 1000)] = 10
    arrival_noise: tuple[ArrivalDeviation, ArrivalDeviation] = (0.03, 0.03)
    linearisation: Linearisation = "published"
    bounds: Bounds = "box"


@dataclass(frozen=True)
class RecurrentSettings(_Checked, path=f"{PATH}.recurrent"):
    """Settings of the recurrent network.

    Attributes:
        weights: Name of weights that ship with the package, or a file. A pair, one for releases of
            flows and one for releases of speeds, goes by the name that they share: ``roads``
            stands for ``roads-flows`` or ``roads-speeds``. None takes ``highway`` or
            ``long-highway`` on roads like those of the package, with noise that they were trained
            on, and ``roads`` otherwise. Outside of the ranges on their card they are used with a
            warning that names these, and ``EnvConfig.inherited`` has this setting.
    """

    weights: str | None = None


@dataclass(frozen=True)
class DemandSettings(_Checked, path=f"{PATH}.demand"):
    """Settings of demand states: factors on the demands at the entries, estimated as well.

    A factor x begins at 1 and returns to it (an AR(1) process), with noise that keeps its variance:
    x' = 1 + c (x - 1) + N(0, (1 - c^2) deviation^2), c = exp(-T / memory) in a step of T.

    The defaults are those of traffic. They were fitted to the autocovariance of what enters the
    built-in roads over the published demand, in minutes and less the variance of a Poisson process,
    on training seeds (200 of `PrivateHighway-v1`, 100 of the paper's road and of the short one, 25
    of the long one). At the mainline's entry factors deviate by more, for queues that reach it and
    leave again; at ramps by less and for longer, as the level of the demand does.

    Attributes:
        deviation: Standard deviation of a factor.
        memory: Seconds in which a deviation falls to 1 / e.
    """

    deviation: Annotated[float, Interval(1e-3, 1)] = 0.23
    memory: Annotated[float, Interval(1, 1e5)] = 55.0


@dataclass(frozen=True)
class BlendSettings(_Checked, path=f"{PATH}.blend"):
    """Settings of the blend of an EKF and a random walk beside `EstimatorSettings`.

    Attributes:
        density_weight: Weight of the EKF's density; the random walk's has the rest.
        speed_weight: Weight of the EKF's speed; the random walk's has the rest.
    """

    density_weight: Annotated[float, Interval(0, 1)] = 0.6
    speed_weight: Annotated[float, Interval(0, 1)] = 0.6


@dataclass(frozen=True)
class AdaptiveSmoothingSettings(_Checked, path=f"{PATH}.asm"):
    """Constants of adaptive smoothing (Treiber and Helbing, 2002), the same for all quantities.

    Attributes:
        time: tau [s], the time in which the weight of a value falls to 1 / e.
        length: s [km], the distance in which it falls to 1 / e.
        free_wave: Speed at which traffic that flows freely carries changes downstream [km/h].
        jam_wave: Speed at which congested traffic carries changes upstream [km/h].
        threshold: V [km/h], the speed at which traffic counts as half congested.
        transition: dV [km/h], the width of the transition between both.
        boundary_weight: Weight of a second of the model's inputs at an end of the road, beside
            that of a released value.
    """

    time: Annotated[float, Interval(0.1, 300)] = 10.0
    length: Annotated[float, Interval(1e-3, 1)] = 0.1
    free_wave: Annotated[float, Interval(20, 300)] = 120.0
    jam_wave: Annotated[float, Interval(8, 60)] = 18.0
    threshold: Annotated[float, Interval(0, 300)] = 60.0
    transition: Annotated[float, Interval(1, 100)] = 20.0
    boundary_weight: Annotated[float, Interval(0, 1000)] = 1.0


@dataclass(frozen=True)
class EstimatorSettings(_Checked, path=PATH):
    """Tuning of the estimators, in units of the jam density rho_m and of v_f.

    Attributes:
        process_noise: Standard deviations of the process noise of one step: of rho over rho_m, of
            psi over rho_m v_f.
        vehicle_noise: Standard deviations, over rho_m and rho_m v_f, of a further process noise at
            jam density, whose variances are in proportion to rho: of vehicles that the model does
            not foresee, whose w is that of the others, and of psi beside that.
        flicker: Whether measurements also have the deviation of counts from the densities of a
            continuum, `dptse_env.estimators.flicker`; only filters on the model read it.
        demand: Settings of demand states; None for a filter that takes the demands as given.
        walk_noise: Standard deviations of a step of the random walk: of rho over rho_m, of v over
            v_f.
        speed_cap: Largest speed that is reported, over the speed limit of the road; None for the
            model's own bound, 1.1 v_f. It applies to `Estimate.speed` alone: states and standard
            deviations are those of the filter.
        noise_scale: Factors on the standard deviations of the mechanism's noise, of a measured
            density and of a measured flow or speed, for an R that also covers what the model does
            not describe.
        initial_variance: Variance of each normalised component of the prior.
        bounds: Set into which means are projected: the `cone` of physical states or the paper's
            `box`.
        ukf: Further settings of the unscented Kalman filter.
        enkf: Further settings of the ensemble Kalman filter.
        mhe: Further settings of the moving horizon estimator, with separate bounds.
        blend: Further settings of the blend, whose EKF and random walk share the others.
        recurrent: Settings of the recurrent network; of the others it has `initial_variance`,
            `noise_scale` and `speed_cap`.
        asm: Settings of adaptive smoothing, which has the same ones of the others.
    """

    process_noise: tuple[Deviation, Deviation] = (0.01, 0.01)
    vehicle_noise: tuple[Deviation, Deviation] = (0.0, 0.0)
    flicker: bool = False
    demand: DemandSettings | None = None
    walk_noise: tuple[Deviation, Deviation] = (0.025, 0.025)
    speed_cap: Annotated[float, Interval(0, 10, open_low=True)] | None = None
    noise_scale: tuple[NoiseScale, NoiseScale] = (1.0, 1.0)
    initial_variance: Annotated[float, Interval(0, 100, open_low=True)] = 1e-3
    bounds: Bounds = "cone"
    ukf: SigmaPointSettings = field(default_factory=SigmaPointSettings)
    enkf: EnsembleSettings = field(default_factory=EnsembleSettings)
    mhe: HorizonSettings = field(default_factory=HorizonSettings)
    blend: BlendSettings = field(default_factory=BlendSettings)
    recurrent: RecurrentSettings = field(default_factory=RecurrentSettings)
    asm: AdaptiveSmoothingSettings = field(default_factory=AdaptiveSmoothingSettings)
