"""Estimation errors, and the rewards that are derived from them."""

from typing import Any, NamedTuple, Protocol

import numpy as np

from dptse_env.estimators import Estimate
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.registry import Registry, name_of_class

REWARD_TERMS = ("joint", "density", "speed")
"""Terms of the rewards that ship with the package."""


class EstimationError(NamedTuple):
    """The error over the mainline of k episodes at a step.

    Attributes:
        density: Root mean squared density error over all mainline segments [veh/km], shape (k,).
        speed: Root mean squared speed error over the occupied ones [km/h], shape (k,); 0 where
            the mainline is empty.
        n_occupied: Number of mainline segments with a vehicle, shape (k,).
    """

    density: FloatArray
    speed: FloatArray
    n_occupied: IntArray


def estimation_error(
    true_density: FloatArray, true_speed: FloatArray, density: FloatArray, speed: FloatArray
) -> EstimationError:
    """Compare estimates with the truth; all arrays (k, n_mainline), in [veh/km] and [km/h].

    A segment without a vehicle has no speed, so it counts for the density only.
    """
    occupied = true_density > 0
    n_occupied = occupied.sum(axis=1)
    density_error = density - true_density
    speed_error = np.where(occupied, speed - true_speed, 0.0)
    return EstimationError(
        np.sqrt(np.einsum("ki,ki->k", density_error, density_error) / density.shape[1]),
        np.sqrt(np.einsum("ki,ki->k", speed_error, speed_error) / np.maximum(n_occupied, 1)),
        n_occupied,
    )


class ScoredSecond(NamedTuple):
    """The arguments of a reward: a second of k episodes.

    Attributes:
        error: Error of the estimate over the mainline.
        true_density: Shape (k, n_mainline) [veh/km].
        true_speed: Shape (k, n_mainline) [km/h].
        estimate: Estimates and their standard deviations, shape (k, S) each.
        queried: Queried queries, shape (k, G): by default the mainline segments.
        corridor: The road, with the scales of densities and speeds.
    """

    error: EstimationError
    true_density: FloatArray
    true_speed: FloatArray
    estimate: Estimate
    queried: BoolArray
    corridor: Corridor


class Reward(Protocol):
    """A function of a second; classes of rewards take no arguments."""

    def __call__(self, second: ScoredSecond) -> FloatArray:
        """Return the rewards of k episodes, shape (k,), all finite."""


class ErrorReward:
    """Minus the scaled root mean squared error over the mainline.

    ``joint`` pools density and speed errors, each in units of its scale; ``density`` and
    ``speed`` use one of them. The scales are constants of the corridor, so that rewards compare
    across estimators and model parameters.

    Attributes:
        term: One of `REWARD_TERMS`.
    """

    def __init__(self, term: str = "joint") -> None:
        """Choose the term."""
        self.term = term

    def __call__(self, second: ScoredSecond) -> FloatArray:
        """Return the rewards of k episodes, shape (k,)."""
        error, corridor = second.error, second.corridor
        if self.term == "density":
            return -error.density / corridor.scales.density_scale
        if self.term == "speed":
            return -error.speed / corridor.scales.speed_scale
        density = error.density / corridor.scales.density_scale
        speed = error.speed / corridor.scales.speed_scale
        n, m = corridor.geometry.n_mainline, error.n_occupied
        return -np.sqrt((n * density**2 + m * speed**2) / (n + m))


class _CheckedReward:
    """Another reward, whose values are checked, with a ``term``."""

    def __init__(self, reward: Reward) -> None:
        self.reward = reward
        self.term = getattr(reward, "term", "joint")

    def __call__(self, second: ScoredSecond) -> FloatArray:
        k = len(second.queried)
        values = np.asarray(self.reward(second))
        if values.shape != (k,) or values.dtype.kind not in "biuf" or not np.isfinite(values).all():
            raise ValueError(
                f"reward {name_of_class(self.reward)} must return finite numbers of shape ({k},), "
                f"got {values.dtype} of shape {values.shape}: {values}"
            )
        return values.astype(np.float64)


REWARDS = Registry(
    "reward",
    {term: ErrorReward(term) for term in REWARD_TERMS},
    check=lambda part: None if callable(part) else "be callable with a ScoredSecond",
)
"""Rewards by name."""


def make_reward(value: Any) -> Any:
    """Return the reward that a keyword's value stands for: a name, a function, object or class.

    Its attribute ``term`` determines the errors that greedy schedules weigh, by default ``joint``.

    Raises:
        ValueError: There is no such reward, or it cannot be called.
    """
    reward = REWARDS.find(value)
    if isinstance(reward, type):
        made = reward()
        if not callable(made):
            raise ValueError(f"reward {name_of_class(reward)} must be callable with a ScoredSecond")
        reward = made
    return reward if isinstance(reward, ErrorReward) else _CheckedReward(reward)
