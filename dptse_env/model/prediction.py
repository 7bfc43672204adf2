"""Errors of a model's predictions of recorded traffic, and those of persistence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dptse_env.model.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray

HORIZONS = (5, 10, 15, 20, 25, 30)


@dataclass(frozen=True)
class TrafficSeries:
    """Traffic of a run over K steps.

    Attributes:
        density: `(K, S)` density of each segment [veh/km].
        speed: `(K, S)` mean speed of each segment [km/h]; ignored where there is no vehicle.
        boundary_density: `(K, R)` density of the boundary cells [veh/km].
        boundary_speed: `(K, R)` mean speed of the boundary cells [km/h]; ignored where empty.

    Raises:
        ValueError: Shapes disagree, or a density or an occupied segment's speed is no
            non-negative number.
    """

    density: FloatArray
    speed: FloatArray
    boundary_density: FloatArray
    boundary_speed: FloatArray

    def __post_init__(self) -> None:
        """Check shapes and values."""
        for density, speed in (("density", "speed"), ("boundary_density", "boundary_speed")):
            rho, v = getattr(self, density), getattr(self, speed)
            if rho.ndim != 2 or v.shape != rho.shape or len(rho) != len(self.density):
                raise ValueError(
                    f"series.{density} and series.{speed} must share a shape of "
                    f"{len(self.density)} steps by cells, got {rho.shape} and {v.shape}"
                )
            if not np.all((rho >= 0.0) & np.isfinite(rho)):
                raise ValueError(f"series.{density} must be finite and >= 0 everywhere")
            occupied = v[rho > 0.0]
            if not np.all((occupied >= 0.0) & np.isfinite(occupied)):
                raise ValueError(f"series.{speed} must be finite and >= 0 wherever vehicles are")

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.density)


@dataclass(frozen=True)
class PredictionError:
    """Root mean square errors over the mainline, an entry per horizon.

    Attributes:
        horizons: Steps ahead.
        density: Errors of the density [veh/km].
        speed: Errors of the speed [km/h], over segments with a vehicle at the predicted time.
    """

    horizons: tuple[int, ...]
    density: tuple[float, ...]
    speed: tuple[float, ...]


def prediction_error(
    model: ARZModel,
    data: Sequence[TrafficSeries],
    horizons: Sequence[int] = HORIZONS,
    stride: int = 5,
) -> PredictionError:
    """Error of the model alone, started from the true state at every `stride`-th step.

    The true boundary cells drive the model. Horizons are numbers of steps, ascending.

    Raises:
        ValueError: The horizons do not ascend, or no run is longer than the longest of them.
    """
    _check_horizons(data, horizons, stride)
    errors = _Errors(horizons, model.network.n_mainline)
    for series in data:
        starts = np.arange(0, len(series) - horizons[-1], stride)
        inputs = model.boundary_inputs(series.boundary_density, series.boundary_speed)
        states = _true_states(model, series)[starts]
        for ahead in range(1, horizons[-1] + 1):
            states = model.step(states, inputs[starts + ahead - 1])
            if ahead in horizons:
                errors.add(
                    ahead, model.density(states), model.speed(states), series, starts + ahead
                )
    return errors.summary()


def persistence_error(
    data: Sequence[TrafficSeries],
    n_mainline: int,
    horizons: Sequence[int] = HORIZONS,
    stride: int = 5,
) -> PredictionError:
    """Error of predicting no change, for the same times as `prediction_error`.

    A segment that is empty at the start has no speed and is left out of the speed's error.
    """
    _check_horizons(data, horizons, stride)
    errors = _Errors(horizons, n_mainline)
    for series in data:
        starts = np.arange(0, len(series) - horizons[-1], stride)
        speed = np.where(series.density > 0.0, series.speed, np.nan)[starts]
        for ahead in horizons:
            errors.add(ahead, series.density[starts], speed, series, starts + ahead)
    return errors.summary()


class _Errors:
    """Sums of squared errors by horizon."""

    def __init__(self, horizons: Sequence[int], n_mainline: int) -> None:
        self.horizons = tuple(horizons)
        self.n_mainline = n_mainline
        self.sums = np.zeros((len(self.horizons), 2))
        self.counts = np.zeros((len(self.horizons), 2))

    def add(
        self,
        ahead: int,
        density: FloatArray,
        speed: FloatArray,
        series: TrafficSeries,
        steps: IntArray,
    ) -> None:
        row, n = self.horizons.index(ahead), self.n_mainline
        true_density = series.density[steps, :n]
        errors = density[:, :n] - true_density
        self.sums[row, 0] += np.sum(errors**2)
        self.counts[row, 0] += errors.size
        seen = (true_density > 0.0) & ~np.isnan(speed[:, :n])
        errors = (speed[:, :n] - series.speed[steps, :n])[seen]
        self.sums[row, 1] += np.sum(errors**2)
        self.counts[row, 1] += errors.size

    def summary(self) -> PredictionError:
        rmse = np.sqrt(self.sums / np.maximum(self.counts, 1.0))
        return PredictionError(
            self.horizons, tuple(rmse[:, 0].tolist()), tuple(rmse[:, 1].tolist())
        )


def _true_states(model: ARZModel, series: TrafficSeries) -> FloatArray:
    """Return the states of the recorded traffic, with the free speed on empty segments."""
    v_f = model.parameters.free_flow_speed
    speed = np.where(series.density > 0.0, series.speed, v_f)
    return model.project(model.states(series.density, speed))


def _check_horizons(data: Sequence[TrafficSeries], horizons: Sequence[int], stride: int) -> None:
    if not horizons or horizons[0] < 1 or list(horizons) != sorted(set(horizons)):
        raise ValueError(f"horizons must be ascending steps >= 1, got {tuple(horizons)}")
    if stride < 1:
        raise ValueError(f"stride must be >= 1, got {stride}")
    longest = max((len(series) for series in data), default=0)
    if longest <= horizons[-1]:
        raise ValueError(
            f"data must hold a run longer than the longest horizon of {horizons[-1]} steps, "
            f"got {longest}"
        )
