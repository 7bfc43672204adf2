"""Errors of a model's predictions of recorded traffic, and parameters fitted for small ones.

The fit has two stages. Densities are binned and the equilibrium speed
`V_e = v_f (1 - (rho/rho_m)^gamma)` is fitted to the bins as a start. Then (v_f, rho_m, gamma, tau)
are optimised for the predictions of the next 5 to 30 s by the model, started from the true state.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from dptse_env.model.model import ARZModel
from dptse_env.model.network import RoadNetwork
from dptse_env.model.parameters import ARZParameters
from dptse_env.utils.arrays import FloatArray, IntArray

Traffic = tuple[FloatArray, FloatArray]  # densities and speeds (k, S)

HORIZONS = (5, 10, 15, 20, 25, 30)
"""Steps ahead whose errors count by default."""

# Bounds of the search: v_f [km/h], rho_m as a multiple of the least admissible one, gamma, tau [s].
# Beyond 150 km/h a higher v_f still improves predictions a little, but not filters.
_LOWEST = np.array([30.0, 1.0, 0.1, 5.0])
_HIGHEST = np.array([150.0, 4.0, 5.0, 500.0])
_WIDTH = 0.2  # first steps of the search, as shares of the values
_REFUSED = 1e3  # loss of parameters that violate the CFL condition; persistence has 1


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

    def predicted(series: TrafficSeries, starts: IntArray) -> Iterator[Traffic]:
        inputs = model.boundary_inputs(series.boundary_density, series.boundary_speed)
        v_f = model.parameters.free_flow_speed  # the speed of empty segments
        speed = np.where(series.density > 0.0, series.speed, v_f)
        states = model.project(model.states(series.density, speed))[starts]
        for ahead in range(1, horizons[-1] + 1):
            states = model.step(states, inputs[starts + ahead - 1])
            if ahead in horizons:
                yield model.density(states), model.speed(states)

    return _error_of(predicted, data, model.network.n_mainline, horizons, stride)


def persistence_error(
    data: Sequence[TrafficSeries],
    n_mainline: int,
    horizons: Sequence[int] = HORIZONS,
    stride: int = 5,
) -> PredictionError:
    """Error of predicting no change, for the same times as `prediction_error`.

    A segment that is empty at the start has no speed and is left out of the speed's error.
    """

    def predicted(series: TrafficSeries, starts: IntArray) -> Iterator[Traffic]:
        speed = np.where(series.density > 0.0, series.speed, np.nan)[starts]
        for _ in horizons:
            yield series.density[starts], speed

    return _error_of(predicted, data, n_mainline, horizons, stride)


def _error_of(
    predicted: Callable[[TrafficSeries, IntArray], Iterator[Traffic]],
    data: Sequence[TrafficSeries],
    n: int,
    horizons: Sequence[int],
    stride: int,
) -> PredictionError:
    """Return the error of what is predicted for each horizon, from the starts of each run on."""
    _check_horizons(data, horizons, stride)
    sums, counts = np.zeros((2, len(horizons), 2))
    for series in data:
        starts = np.arange(0, len(series) - horizons[-1], stride)
        pairs = zip(horizons, predicted(series, starts), strict=True)
        for row, (ahead, (density, speed)) in enumerate(pairs):
            there = series.density[starts + ahead, :n]
            seen = (there > 0.0) & ~np.isnan(speed[:, :n])
            of_speed = (speed[:, :n] - series.speed[starts + ahead, :n])[seen]
            for quantity, errors in enumerate((density[:, :n] - there, of_speed)):
                sums[row, quantity] += np.sum(errors**2)
                counts[row, quantity] += errors.size
    density_error, speed_error = np.sqrt(sums / np.maximum(counts, 1.0)).T.tolist()
    return PredictionError(tuple(horizons), tuple(density_error), tuple(speed_error))


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


@dataclass(frozen=True)
class Calibration:
    """Outcome of `calibrate`.

    Attributes:
        parameters: The fitted parameters.
        start: Start of the search.
        error: Prediction error of the fit on the training data.
        persistence: Prediction error of persistence on the same data.
        loss: Mean over horizons of error over persistence's; below 1 the model is better.
        n_evaluations: Number of models tried.
        at_bounds: Parameters at a bound of the search: the data do not distinguish them from larger
            or smaller ones, often since v_f and gamma compensate for each other.
    """

    parameters: ARZParameters
    start: ARZParameters
    error: PredictionError
    persistence: PredictionError
    loss: float
    n_evaluations: int
    at_bounds: tuple[str, ...]


def starting_parameters(
    network: RoadNetwork,
    data: Sequence[TrafficSeries],
    name: str = "start",
    bin_width: float = 10.0,
) -> ARZParameters:
    """Fit the equilibrium speed to mean speeds of the mainline in density bins [veh/km].

    Raises:
        ValueError: The data fill fewer than four bins.
    """
    n = network.n_mainline
    density = np.concatenate([series.density[:, :n].ravel() for series in data])
    speed = np.concatenate([series.speed[:, :n].ravel() for series in data])
    density, speed = density[density > 0.0], speed[density > 0.0]
    bins = np.floor(density / bin_width).astype(np.int64)
    counts = np.bincount(bins)
    filled = counts >= min(10, density.size)
    if filled.sum() < 4:
        raise ValueError(
            f"data must fill at least 4 density bins of {bin_width} veh/km, got {filled.sum()}"
        )
    centre = np.bincount(bins, density)[filled] / counts[filled]
    mean_speed = np.bincount(bins, speed)[filled] / counts[filled]
    least_jam = _least_jam_density(network, data)

    def residual(values: FloatArray) -> FloatArray:
        v_f, scale, gamma = values
        return np.asarray(v_f * (1.0 - (centre / (scale * least_jam)) ** gamma) - mean_speed)

    start = np.clip([1.1 * mean_speed.max(), 1.2, 1.0], _LOWEST[:3], _HIGHEST[:3])
    fit = optimize.least_squares(residual, start, bounds=(_LOWEST[:3], _HIGHEST[:3]))
    v_f, scale, gamma = (float(value) for value in fit.x)
    return ARZParameters(name, v_f, scale * least_jam, gamma, 60.0, _most_lanes(network))


def calibrate(
    network: RoadNetwork,
    data: Sequence[TrafficSeries],
    name: str,
    start: ARZParameters | None = None,
    horizons: Sequence[int] = HORIZONS,
    stride: int = 5,
    time_step: float = 1.0,
    max_evaluations: int = 400,
) -> Calibration:
    """Fit (v_f, rho_m, gamma, tau) to runs of traffic, to be tested on other runs.

    The jam density stays above the largest density in the data, and the CFL condition holds.

    Args:
        network: The road of the data.
        data: Training runs.
        name: Name of the fitted set.
        start: Start of the search; by default `starting_parameters`.
        horizons: Steps ahead whose errors count, ascending.
        stride: Steps between two starts of a prediction.
        time_step: Seconds between two rows of the data.
        max_evaluations: Largest number of models to try.
    """
    start = start or starting_parameters(network, data)
    least_jam = _least_jam_density(network, data)
    persistence = persistence_error(data, network.n_mainline, horizons, stride)

    def parameters_at(values: FloatArray) -> ARZParameters:
        v_f, scale, gamma, tau = np.clip(np.exp(values), _LOWEST, _HIGHEST).tolist()
        return ARZParameters(name, v_f, scale * least_jam, gamma, tau, _most_lanes(network))

    def loss(values: FloatArray) -> float:
        model = ARZModel(network, parameters_at(values), time_step)
        try:
            model.require_time_step()
        except ValueError:
            return _REFUSED
        return _relative(prediction_error(model, data, horizons, stride), persistence)

    jam = start.jam_density / start.lanes * _most_lanes(network)
    first = [start.free_flow_speed, jam / least_jam, start.gamma, start.relaxation_time]
    simplex = _simplex(np.log(first))
    found = optimize.minimize(
        loss,
        simplex[0],
        method="Nelder-Mead",
        bounds=list(zip(np.log(_LOWEST), np.log(_HIGHEST), strict=True)),
        options={
            "maxfev": max_evaluations,
            "xatol": 1e-3,
            "fatol": 1e-5,
            "initial_simplex": simplex,
        },
    )
    parameters = parameters_at(found.x)
    error = prediction_error(ARZModel(network, parameters, time_step), data, horizons, stride)
    names = ("free_flow_speed", "jam_density", "gamma", "relaxation_time")
    distance = np.minimum(found.x - np.log(_LOWEST), np.log(_HIGHEST) - found.x)
    return Calibration(
        parameters,
        start,
        error,
        persistence,
        loss=float(found.fun),
        n_evaluations=int(found.nfev),
        at_bounds=tuple(name for name, gap in zip(names, distance, strict=True) if gap < 0.01),
    )


def _simplex(start: FloatArray) -> FloatArray:
    """Return the first simplex of a search in logarithms, within bounds and not degenerate."""
    low, high = np.log(_LOWEST), np.log(_HIGHEST)
    first = np.clip(start, low, high - _WIDTH)
    return np.vstack([first, first + _WIDTH * np.eye(first.size)])


def _most_lanes(network: RoadNetwork) -> int:
    """Return the largest number of lanes of the mainline, to which a jam density applies."""
    return max(network.segment_lanes[: network.n_mainline])


def _least_jam_density(network: RoadNetwork, data: Sequence[TrafficSeries]) -> float:
    """Return just above the largest density per lane, for the lanes of `_most_lanes`."""
    lanes = np.asarray(network.segment_lanes, dtype=np.float64)
    largest = max(float(np.max(series.density / lanes)) for series in data)
    return 1.01 * largest * _most_lanes(network)


def _relative(error: PredictionError, reference: PredictionError) -> float:
    ratios = [
        np.divide(error.density, np.maximum(reference.density, 1e-9)),
        np.divide(error.speed, np.maximum(reference.speed, 1e-9)),
    ]
    value = float(np.mean(ratios))
    return value if np.isfinite(value) else _REFUSED
