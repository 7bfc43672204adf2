"""What every estimator is: the protocol, its settings and its output.

An estimator follows a batch of episodes. A step is `predict` under the boundary inputs, then
`update` by what was released, then `estimate`. Both take the indices of the episodes they
concern; the others stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, get_args

import numpy as np

from dptse_env.model import Bounds
from dptse_env.model.network import BoolArray, FloatArray, IntArray
from dptse_env.validation import integer, non_negative, positive, sequence

Backend = Literal["compiled", "reference"]
Linearisation = Literal["paper", "trajectory"]

# qpsolvers passes these on although they return false optima of such programs as found.
REFUSED_SOLVERS = ("highs",)


@dataclass(frozen=True)
class Estimate:
    """Estimates and their standard deviations, `(n, S)` each, in fresh arrays.

    Attributes:
        density: [veh/km].
        speed: [km/h].
        density_std: [veh/km].
        speed_std: [km/h].
    """

    density: FloatArray
    speed: FloatArray
    density_std: FloatArray
    speed_std: FloatArray

    def at(self, episodes: IntArray) -> Estimate:
        """Return a copy of the rows of `episodes` `(k,)`, `(k, S)` each."""
        return Estimate(
            self.density[episodes],
            self.speed[episodes],
            self.density_std[episodes],
            self.speed_std[episodes],
        )


class Estimator(Protocol):
    """Estimates the traffic state of a batch of episodes, S segments each.

    Attributes:
        n_episodes: Episodes n in the batch.
        innovations: `(n, S, 2)` residuals of density and speed before the last update, over their
            predicted standard deviations; 0 where nothing was observed.
        diverged: `(n,)` whether the last update found the filter non-finite or indefinite and
            put it back to its prior.
    """

    n_episodes: int
    innovations: FloatArray
    diverged: BoolArray

    def reset(
        self,
        episodes: IntArray,
        states: FloatArray,
        generators: Sequence[np.random.Generator],
    ) -> None:
        """Start episodes over.

        Args:
            episodes: `(k,)` distinct indices.
            states: `(k, 2 S)` prior means.
            generators: One random stream an episode, for estimators that draw.
        """

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Move episodes `(k,)` one step ahead under the model's inputs `(k, n_u)`."""

    def update(
        self, episodes: IntArray, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        """Take in measurements.

        Args:
            episodes: `(k,)` distinct indices.
            observed: `(k, S)` which segments were measured.
            values: `(k, S, 2)` density [veh/km] and speed [km/h]; ignored where not observed.
            sigma: `(2,)` standard deviations of their noise [veh/km, km/h].
        """

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""


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
        object.__setattr__(self, "horizon", integer("estimator.mhe.horizon", self.horizon, 1))
        pair = sequence("estimator.mhe.arrival_noise", self.arrival_noise, length=2)
        noise = tuple(positive(f"estimator.mhe.arrival_noise[{i}]", v) for i, v in enumerate(pair))
        object.__setattr__(self, "arrival_noise", noise)
        for name, allowed in (
            ("linearisation", get_args(Linearisation)),
            ("bounds", get_args(Bounds)),
        ):
            value = getattr(self, name)
            if value not in allowed:
                names = " or ".join(map(repr, allowed))
                raise ValueError(f"estimator.mhe.{name} must be {names}, got {value!r}")
        if self.solver in REFUSED_SOLVERS:
            raise ValueError(
                f"estimator.mhe.solver must not be {self.solver!r}, which reports false optima of "
                "these programs as found; use 'piqp'"
            )


@dataclass(frozen=True)
class EstimatorSettings:
    """Tuning of the estimators, in units of the jam density rho_m and of v_f.

    Attributes:
        process_noise: Standard deviations of what the model misses in one step: of rho over
            rho_m, of psi over rho_m v_f.
        walk_noise: The same of the random walk: of rho over rho_m, of v over v_f.
        initial_variance: Variance of each normalised component of the prior.
        bounds: Where means are held: the `cone` of physical states or the paper's `box`.
        mhe: What the moving horizon estimator needs beside these; its bounds are its own.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    process_noise: tuple[float, float] = (0.01, 0.01)
    walk_noise: tuple[float, float] = (0.025, 0.025)
    initial_variance: float = 1e-3
    bounds: Bounds = "cone"
    mhe: HorizonSettings = field(default_factory=HorizonSettings)

    def __post_init__(self) -> None:
        """Check values; lists, as JSON has them, become tuples."""
        for name in ("process_noise", "walk_noise"):
            path = f"estimator.{name}"
            pair = sequence(path, getattr(self, name), length=2)
            noise = tuple(non_negative(f"{path}[{i}]", value) for i, value in enumerate(pair))
            object.__setattr__(self, name, noise)
        if isinstance(self.mhe, Mapping):
            object.__setattr__(self, "mhe", HorizonSettings(**self.mhe))
        variance = positive("estimator.initial_variance", self.initial_variance)
        object.__setattr__(self, "initial_variance", variance)
        if self.bounds not in get_args(Bounds):
            raise ValueError(f"estimator.bounds must be 'cone' or 'box', got {self.bounds!r}")
