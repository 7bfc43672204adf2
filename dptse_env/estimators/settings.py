"""How the estimators are tuned: frozen dataclasses, reachable from plain JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, get_args

from dptse_env.model import Bounds
from dptse_env.validation import finite, integer, non_negative, positive, require, sequence

Linearisation = Literal["paper", "trajectory"]

# qpsolvers passes these on although they return false optima of such programs as found.
REFUSED_SOLVERS = ("highs",)

_PATH = "estimator_settings"
_T = TypeVar("_T")


def _name(path: str, value: object, allowed: tuple[str, ...]) -> None:
    names = " or ".join(map(repr, allowed))
    require(value in allowed, path, names, value)


@dataclass(frozen=True)
class SigmaPointSettings:
    """Where the unscented Kalman filter puts its points (van der Merwe, 2004), the paper's values.

    Attributes:
        alpha: Spread of the points, in (0, 1].
        beta: Weight of the first point in covariances, >= 0; 2 suits normal distributions.
        kappa: Secondary spread; above minus the number of states.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    alpha: float = 0.1
    beta: float = 2.0
    kappa: float = -4.0

    def __post_init__(self) -> None:
        """Check values."""
        alpha = positive(f"{_PATH}.ukf.alpha", self.alpha)
        require(alpha <= 1.0, f"{_PATH}.ukf.alpha", "in (0, 1]", alpha)
        non_negative(f"{_PATH}.ukf.beta", self.beta)
        finite(f"{_PATH}.ukf.kappa", self.kappa)


@dataclass(frozen=True)
class EnsembleSettings:
    """What the ensemble Kalman filter needs beside `EstimatorSettings`.

    Attributes:
        n_members: Members of an ensemble, >= 2.
        inflation: Factor on the members' distances from their mean ahead of every update
            (Anderson and Anderson, 1999), >= 1; 1 leaves them as they are.
        taper: Distance along the road [km] from which a measurement no longer acts on a state
            (Gaspari and Cohn, 1999); None for no limit.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    n_members: int = 100
    inflation: float = 1.0
    taper: float | None = None

    def __post_init__(self) -> None:
        """Check values."""
        integer(f"{_PATH}.enkf.n_members", self.n_members, 2)
        inflation = positive(f"{_PATH}.enkf.inflation", self.inflation)
        require(inflation >= 1.0, f"{_PATH}.enkf.inflation", ">= 1", inflation)
        if self.taper is not None:
            positive(f"{_PATH}.enkf.taper", self.taper)


@dataclass(frozen=True)
class HorizonSettings:
    """What a moving horizon estimator needs beside `EstimatorSettings`.

    The weights of the paper's objective (eq. 14) are inverse variances, so that H is the inverse
    covariance of the window: mu of `arrival_noise`, w_1 of the measurements' known noise and w_2
    of `EstimatorSettings.process_noise`. While the window grows its arrival is the prior, of
    `EstimatorSettings.initial_variance`.

    Attributes:
        horizon: N, steps that the window reaches back, >= 1.
        arrival_noise: Standard deviations of the predicted state at the window's start, of rho
            over rho_m and psi over rho_m v_f.
        linearisation: `paper`: each stage once, where it enters the window, at the mean of the
            solution before; `trajectory`: all stages anew at every step along that solution.
        bounds: `box`, the paper's, or `cone`: the program is held to the smallest box around the
            cone of physical states, and its last state is projected into the cone.
        solver: Solver that qpsolvers is asked for.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    horizon: int = 10
    arrival_noise: tuple[float, float] = (0.03, 0.03)
    linearisation: Linearisation = "paper"
    bounds: Bounds = "box"
    solver: str = "piqp"

    def __post_init__(self) -> None:
        """Check values; lists, as JSON has them, become tuples."""
        path = f"{_PATH}.mhe"
        object.__setattr__(self, "horizon", integer(f"{path}.horizon", self.horizon, 1))
        pair = sequence(f"{path}.arrival_noise", self.arrival_noise, length=2)
        noise = tuple(positive(f"{path}.arrival_noise[{i}]", v) for i, v in enumerate(pair))
        object.__setattr__(self, "arrival_noise", noise)
        _name(f"{path}.linearisation", self.linearisation, get_args(Linearisation))
        _name(f"{path}.bounds", self.bounds, get_args(Bounds))
        if self.solver in REFUSED_SOLVERS:
            raise ValueError(
                f"{path}.solver must not be {self.solver!r}, which reports false optima of "
                "these programs as found; use 'piqp'"
            )


@dataclass(frozen=True)
class EstimatorSettings:
    """Tuning of the estimators, in units of the jam density rho_m and of v_f.

    Attributes:
        process_noise: Standard deviations of what the model misses in one step: of rho over
            rho_m, of psi over rho_m v_f.
        walk_noise: The same of the random walk: of rho over rho_m, of v over v_f.
        noise_scale: Factor on the known standard deviations of the measurements' noise, for an R
            that also covers what a count of vehicles says of a density; 1 is the mechanism's own.
        initial_variance: Variance of each normalised component of the prior.
        bounds: Where means are held: the `cone` of physical states or the paper's `box`.
        ukf: What the unscented Kalman filter needs beside these.
        enkf: What the ensemble Kalman filter needs beside these.
        mhe: What the moving horizon estimator needs beside these; its bounds are its own.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    process_noise: tuple[float, float] = (0.01, 0.01)
    walk_noise: tuple[float, float] = (0.025, 0.025)
    noise_scale: float = 1.0
    initial_variance: float = 1e-3
    bounds: Bounds = "cone"
    ukf: SigmaPointSettings = field(default_factory=SigmaPointSettings)
    enkf: EnsembleSettings = field(default_factory=EnsembleSettings)
    mhe: HorizonSettings = field(default_factory=HorizonSettings)

    def __post_init__(self) -> None:
        """Check values; lists, as JSON has them, become tuples."""
        for name in ("process_noise", "walk_noise"):
            path = f"{_PATH}.{name}"
            pair = sequence(path, getattr(self, name), length=2)
            noise = tuple(non_negative(f"{path}[{i}]", value) for i, value in enumerate(pair))
            object.__setattr__(self, name, noise)
        for name in ("noise_scale", "initial_variance"):
            object.__setattr__(self, name, positive(f"{_PATH}.{name}", getattr(self, name)))
        _name(f"{_PATH}.bounds", self.bounds, get_args(Bounds))
        for name, own in (
            ("ukf", SigmaPointSettings),
            ("enkf", EnsembleSettings),
            ("mhe", HorizonSettings),
        ):
            object.__setattr__(self, name, _built(own, getattr(self, name)))


def _built(cls: type[_T], value: Any) -> _T:
    """A nested dataclass, also from its dict."""
    return cls(**value) if isinstance(value, Mapping) else value
