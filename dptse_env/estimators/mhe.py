"""Moving horizon estimation (paper, eq. 14 to 17).

A window holds L = T + 1 stages; z stacks their normalised states, rho by rho_m and psi by
rho_m v_f; a demand factor is a number without a unit. Its program is the paper's eq. 17,
`minimise z' H z + q' z with lower <= z <= upper`. The reference shares its bounds and weights,
which are at the end.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators import ekf
from dptse_env.estimators.base import Measurement
from dptse_env.estimators.ekf import CovarianceFilter, Filters, initial_variance, process_noise
from dptse_env.estimators.linalg import apply, padded
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.estimators.window import (
    NEWTON,
    UNSOLVED,
    Window,
    evaluate,
    factorise,
    make_factor,
    make_iterate,
    minimise,
)
from dptse_env.model import ARZModel, Bounds
from dptse_env.model.arrays import ARZ, Channels
from dptse_env.model.parameters import (
    LARGEST_FACTOR,
    LARGEST_W,
    LEAST_DENSITY,
    LEAST_FACTOR,
    LEAST_W,
)
from dptse_env.model.step import advance, make_scratch, normalise, project, write_channel
from dptse_env.road import Road
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import (
    Bundle,
    all_finite,
    any_of,
    copy_matrix,
    copy_vector,
    kernel,
    kernel_part,
)
from dptse_env.utils.validation import integer, positive

# Least deviation of a measurement, normalised: an exact one would have an infinite weight.
LEAST_DEVIATION = 1e-3

MOST_VARIABLES = 3000
"""Variables of the longest window.

With as many a step takes 10 to 20 ms, and up to a second where most of them are at bounds and the
model is trusted almost entirely, so that every bound moves the whole window.
"""


class Windows(NamedTuple):
    """Windows of n episodes, up to L = horizon + 2 stages each; normalised but for inputs.

    A prediction makes a full window one stage longer, until the update drops the oldest one.
    """

    length: IntArray  # (n,) stages in use
    arrival_variance: FloatArray  # (n, n_x) in use
    predicted: FloatArray  # (n, L, n_x) predictions of stages; the first is the arrival's mean
    inputs: FloatArray  # (n, L, n_u) of the step that leaves each stage
    process_variance: FloatArray  # (n, L, n_x) likewise
    slopes: FloatArray  # (n, L, S) likewise
    blocks: FloatArray  # (n, L, S, K, 4) likewise
    by_factor: FloatArray  # (n, L, E, 3) likewise, of the demand factors; E = 0 without
    offsets: FloatArray  # (n, L, n_x) likewise
    observed: BoolArray  # (n, L, M)
    values: FloatArray  # (n, L, M, 2)
    noise: FloatArray  # (n, L, M, 2)
    centre: FloatArray  # (n, L, S) v_0 [km/h] of each stage's flows, NaN where they are speeds
    weights: FloatArray  # (n, L, M, 2, 2 x largest span) of linearised channels
    targets: FloatArray  # (n, L, M, 2) values less the constants of these
    solution: FloatArray  # (n, L, padded)
    active_set: IntArray  # (n, L, padded) bounds that the last solution is at, -1, 0 or 1
    point: FloatArray  # (n, padded) where the last stage is linearised, unless along the solution
    solved: IntArray  # (n,) how the last program was solved; `UNSOLVED` where there was none too
    fallback: BoolArray  # (n,) whether the last program was not solved, so the prediction stays
    moving_variance: FloatArray  # (n_x,) arrival variance of a window that moves
    lower: FloatArray  # (n_x,)
    upper: FloatArray  # (n_x,)
    units: FloatArray  # (n_x,) of normalised states
    along: bool  # whether to linearise along the last solution


@kernel
def restart(bundle: Bundle, e: int) -> None:
    """Reset an episode to a window of a single stage, its prior."""
    _, _, _, filters, windows = bundle.parts
    ekf.restart(filters, e)
    windows.length[e], windows.solved[e] = 1, UNSOLVED
    copy_vector(filters.initial_variance, windows.arrival_variance[e])
    _enter(filters, windows, e, 0)
    copy_vector(windows.solution[e, 0], windows.point[e])


@kernel_part
def _enter(filters: Filters, windows: Windows, e: int, t: int) -> None:
    """Add the mean as a stage without measurements."""
    for i in range(windows.units.size):
        windows.predicted[e, t, i] = filters.means[e, i] / windows.units[i]
        windows.solution[e, t, i] = windows.predicted[e, t, i]
    windows.observed[e, t] = False
    windows.active_set[e, t] = 0
    windows.noise[e, t] = 1.0


@kernel_part
def _shift(windows: Windows, e: int) -> None:
    """Drop the oldest stage of a full window."""
    if windows.length[e] < windows.solution.shape[1]:
        return
    windows.length[e] -= 1
    copy_vector(windows.moving_variance, windows.arrival_variance[e])
    n_stages = windows.solution.shape[1]
    _drop(windows.predicted[e].reshape(n_stages, -1))
    _drop(windows.inputs[e].reshape(n_stages, -1))
    _drop(windows.process_variance[e].reshape(n_stages, -1))
    _drop(windows.slopes[e].reshape(n_stages, -1))
    _drop(windows.blocks[e].reshape(n_stages, -1))
    _drop(windows.by_factor[e].reshape(n_stages, -1))
    _drop(windows.offsets[e].reshape(n_stages, -1))
    _drop(windows.observed[e].reshape(n_stages, -1))
    _drop(windows.values[e].reshape(n_stages, -1))
    _drop(windows.noise[e].reshape(n_stages, -1))
    _drop(windows.centre[e].reshape(n_stages, -1))
    _drop(windows.weights[e].reshape(n_stages, -1))
    _drop(windows.targets[e].reshape(n_stages, -1))
    _drop(windows.solution[e].reshape(n_stages, -1))
    _drop(windows.active_set[e].reshape(n_stages, -1))


@kernel_part
def _drop(stages: FloatArray) -> None:
    for t in range(stages.shape[0] - 1):
        for i in range(stages.shape[1]):
            stages[t, i] = stages[t + 1, i]


@kernel
def predict(bundle: Bundle, episodes: IntArray, inputs: FloatArray) -> None:
    """Append the model's prediction, under inputs `(k, n_u)`, to each window."""
    road, arz, _, filters, windows = bundle.parts
    scratch, state = make_scratch(road), np.empty(filters.means.shape[1])
    blocks = np.empty((*road.neighbours.shape, 4))
    for k in range(episodes.size):
        e = episodes[k]
        _shift(windows, e)  # where there was no update
        length, point = windows.length[e], windows.point[e]
        point[:] = 0.0
        for t in range(length):
            for i in range(point.size):
                point[i] += windows.solution[e, t, i] / length
        copy_vector(filters.means[e], state)
        variance, slopes = windows.process_variance[e, length - 1], windows.slopes[e, length - 1]
        process_noise(road, filters, state, variance, slopes)
        project(road, arz, state, False)
        advance(road, arz, state, inputs[k], state, blocks, scratch)
        project(road, arz, state, filters.is_box)
        copy_vector(state, filters.means[e])
        copy_vector(inputs[k], windows.inputs[e, length - 1])
        if not windows.along:
            _linearise_step(road, arz, filters, windows, e, length - 1, point)
        windows.length[e] = length + 1
        _enter(filters, windows, e, length)


@kernel_part
def _physical(road: Road, arz: ARZ, windows: Windows, point: FloatArray) -> FloatArray:
    """Return the state in the cone nearest to a normalised point [veh/km, veh/h]."""
    state = np.empty(windows.units.size)
    for i in range(state.size):
        state[i] = point[i] * windows.units[i]
    project(road, arz, state, False)
    return state


@kernel_part
def _linearise_step(
    road: Road, arz: ARZ, filters: Filters, windows: Windows, e: int, t: int, point: FloatArray
) -> None:
    """Linearise the step that leaves a stage, at the physical state nearest to a point."""
    state, scratch = _physical(road, arz, windows, point), make_scratch(road)
    blocks, after, product = windows.blocks[e, t], state.copy(), np.empty(state.size)
    advance(road, arz, state, windows.inputs[e, t], after, blocks, scratch)
    normalise(arz, filters.units[0], blocks, scratch.by_factor)
    n_factors = windows.by_factor.shape[2]
    copy_matrix(scratch.by_factor[:n_factors], windows.by_factor[e, t])
    for i in range(state.size):
        state[i] /= windows.units[i]
    apply(road, blocks, scratch.by_factor, n_factors, state, product)
    for i in range(state.size):  # b = f(x, u) - A x
        windows.offsets[e, t, i] = after[i] / windows.units[i] - product[i]


@kernel_part
def _linearise_channels(
    road: Road, arz: ARZ, channels: Channels, windows: Windows, e: int, t: int, point: FloatArray
) -> None:
    """Linearise the channels of a stage, at the physical state nearest to a point."""
    state, constants = _physical(road, arz, windows, point), np.empty(2)
    for m in range(channels.first.size):
        if windows.observed[e, t, m]:
            weights, centre = windows.weights[e, t, m], windows.centre[e, t]
            write_channel(arz, channels, windows.units, state, centre, m, weights, constants)
            for q in range(2):  # y = z - (h(x) - C x)
                windows.targets[e, t, m, q] = windows.values[e, t, m, q] - constants[q]


@kernel
def update(bundle: Bundle, episodes: IntArray, measured: Measurement) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, arz, channels, filters, windows = bundle.parts
    n, width = windows.units.size, windows.solution.shape[2]
    n_stages = windows.solution.shape[1] - 1
    n_channels, size = windows.weights.shape[2], windows.weights.shape[4]
    factor = make_factor(n_stages, n, n_channels, size, width)
    free = np.zeros((n_stages, n), np.int64)
    for k in range(episodes.size):
        e = episodes[k]
        _shift(windows, e)
        last = windows.length[e] - 1
        copy_vector(measured.observed[k], windows.observed[e, last])
        copy_vector(measured.centre[k], windows.centre[e, last])
        windows.solved[e], windows.fallback[e] = UNSOLVED, False
        sound = _measure(bundle, e, measured, k)
        window, factor.length[0] = window_of(windows, e), 0
        active_set, z = windows.active_set[e, : last + 1], windows.solution[e, : last + 1].copy()
        sound = sound and factorise(road, channels, window, free, factor)
        if sound:
            copy_matrix(factor.covariances[last], filters.covariances[e])
            _innovate(arz, channels, filters, windows, e, factor.before)
            for i in range(windows.units.size):
                sound = sound and all_finite(filters.covariances[e, i])
        if sound and any_of(measured.observed[k]):
            windows.solved[e] = minimise(road, channels, window, factor, active_set, z)
            if windows.solved[e] == UNSOLVED:
                windows.fallback[e] = True
                windows.active_set[e] = 0
            else:
                _accept(road, arz, filters, windows, e, z)
        filters.diverged[e] = not sound
        if not sound:
            restart(bundle, e)


@kernel_part
def _measure(bundle: Bundle, e: int, measured: Measurement, k: int) -> bool:
    """Add what was measured of episode e, the k-th one, to the last stage, and linearise.

    Returns:
        Whether all is finite.
    """
    road, arz, channels, filters, windows = bundle.parts
    values, sigma = measured.values[k], measured.sigma[k]
    last, mean, sound = windows.length[e] - 1, filters.means[e], True
    for i in range(mean.size):
        sound = sound and math.isfinite(mean[i])
    for m in range(channels.first.size):
        for q in range(2):
            unit = filters.units[0] if q == 0 else arz.second_scale
            value = values[m, q] / unit if windows.observed[e, last, m] else 0.0
            windows.values[e, last, m, q] = value
            deviation = max(sigma[m, q], LEAST_DEVIATION * unit) / unit
            windows.noise[e, last, m, q] = deviation**2
            sound = sound and math.isfinite(value)
    if windows.along:
        for t in range(last + 1):
            _linearise_channels(road, arz, channels, windows, e, t, windows.solution[e, t])
            if t < last:
                _linearise_step(road, arz, filters, windows, e, t, windows.solution[e, t])
    else:
        _linearise_channels(road, arz, channels, windows, e, last, windows.point[e])
    return sound


@kernel_part
def _innovate(
    arz: ARZ, channels: Channels, filters: Filters, windows: Windows, e: int, before: FloatArray
) -> None:
    """Write residuals at the prediction over the deviations that the window expects.

    `before` is the covariance before the measurements.
    """
    last, weights, constants = windows.length[e] - 1, windows.weights[e], np.empty(2)
    at_mean = np.empty(weights.shape[2:])
    filters.innovations[e] = 0.0
    for m in range(channels.first.size):
        if not windows.observed[e, last, m]:
            continue
        first, size = 2 * channels.first[m], 2 * channels.span[m]
        mean, centre = filters.means[e], windows.centre[e, last]
        write_channel(arz, channels, windows.units, mean, centre, m, at_mean, constants)
        for q in range(2):
            gap, variance = windows.values[e, last, m, q] - constants[q], 0.0
            for i in range(size):
                gap -= at_mean[q, i] * mean[first + i] / windows.units[first + i]
                for j in range(size):
                    weight = weights[last, m, q, i] * weights[last, m, q, j]
                    variance += weight * before[first + i, first + j]
            deviation = np.sqrt(variance + windows.noise[e, last, m, q])
            filters.innovations[e, m, q] = gap / deviation


@kernel_part
def _accept(
    road: Road, arz: ARZ, filters: Filters, windows: Windows, e: int, z: FloatArray
) -> None:
    """Accept a solution `(L, padded)`, whose last state is the estimate."""
    for t in range(windows.length[e]):
        for i in range(windows.units.size):
            windows.solution[e, t, i] = z[t, i]
            at_lower, at_upper = z[t, i] <= windows.lower[i], z[t, i] >= windows.upper[i]
            windows.active_set[e, t, i] = int(at_upper) - int(at_lower)
    for i in range(windows.units.size):
        filters.means[e, i] = z[windows.length[e] - 1, i] * windows.units[i]
    project(road, arz, filters.means[e], filters.is_box)


@kernel_part
def window_of(windows: Windows, e: int) -> Window:
    """Return the linearised window of an episode; its arrays are views."""
    length = windows.length[e]
    return Window(
        windows.predicted[e, 0],
        windows.arrival_variance[e],
        windows.blocks[e, :length],
        windows.by_factor[e, :length],
        windows.offsets[e, :length],
        windows.process_variance[e, :length],
        windows.slopes[e, :length],
        windows.observed[e, :length],
        windows.weights[e, :length],
        windows.targets[e, :length],
        windows.noise[e, :length],
        windows.lower,
        windows.upper,
    )


@kernel
def write_program(bundle: Bundle, e: int, H: FloatArray, q: FloatArray) -> None:
    """Write H `(L, n_x, L, n_x)` and q `(L, n_x)` of an episode: z' H z + q' z."""
    road, _, channels, _, windows = bundle.parts
    window, length, n = window_of(windows, e), windows.length[e], windows.units.size
    iterate = make_iterate(length, windows.solution.shape[2], windows.observed.shape[2])
    evaluate(road, channels, window, iterate)
    # At z = 0 the negative gradient of half the objective is -q / 2, at a unit vector e less H e.
    start = iterate.negative_gradient.copy()
    q[:] = -2.0 * start[:, :n]
    for t in range(length):
        for i in range(n):
            iterate.z[t, i] = 1.0
            evaluate(road, channels, window, iterate)
            iterate.z[t, i] = 0.0
            H[t, i] = start[:, :n] - iterate.negative_gradient[:, :n]


class MHE(CovarianceFilter):
    """Moving horizon estimation (paper, eq. 14 to 17).

    The program is solved exactly by `window.minimise`, started from the last step's solution.
    Where that finds no optimum, the prediction stays and `fallback` says so. Deviations are those
    of the last state given the window, without bounds.
    """

    predict_kernel = staticmethod(predict)
    update_kernel = staticmethod(update)

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings_of_mhe(settings))
        self._windows = _allocate(model, settings, self.fallback)
        self.arrays = Bundle(*model.dynamics, self.filters, self._windows)
        self._restart(np.arange(n_episodes))

    @staticmethod
    def check_settings(model: ARZModel, settings: EstimatorSettings) -> None:
        """Refuse a process noise of zero, whose weight w_2 would be infinite, and long windows."""
        for i, value in enumerate(settings.process_noise):
            positive(f"estimator_settings.process_noise[{i}]", value)
        most = MOST_VARIABLES // model.n_states - 1
        integer("estimator_settings.mhe.horizon", settings.mhe.horizon, 1, most)

    @property
    def solved(self) -> IntArray:
        """The way in which each episode's last program was solved `(n,)`, a copy.

        `ACTIVE_SET`, `NEWTON`, or `UNSOLVED` where neither found an optimum or nothing was seen.
        """
        return self._windows.solved.copy()

    def program(self, episode: int) -> tuple[FloatArray, FloatArray]:
        """Return H `(L n_x, L n_x)` and q `(L n_x,)` of an episode's last update, normalised.

        Of its L states z' H z + q' z is minimised (paper, eq. 17).
        """
        n, length = self.model.n_states, int(self._windows.length[episode])
        H, q = np.empty((length, n, length, n)), np.empty((length, n))
        write_program(self.arrays, episode, H, q)
        return H.reshape(length * n, length * n), q.ravel()

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        windows: tuple[Any, ...] = self._windows[: Windows._fields.index("fallback")]
        return *super()._memory, *windows

    @property
    def _limits(self) -> tuple[tuple[AnyArray, float, float], ...]:
        windows = self._windows
        return (
            (windows.length, 1, windows.solution.shape[1]),
            (windows.active_set, -1, 1),
            (windows.solved, UNSOLVED, NEWTON),
            (windows.centre, 0.0, np.inf),
        )

    def _restart(self, episodes: IntArray) -> None:
        for episode in episodes.tolist():
            restart(self.arrays, episode)


def _allocate(model: ARZModel, settings: EstimatorSettings, fallback: BoolArray) -> Windows:
    """Return empty windows of n episodes, which write to `fallback` `(n,)`."""
    n, n_channels, n_episodes = model.n_states, model.channels.size, fallback.size
    width, shape = padded(n), (n_episodes, settings.mhe.horizon + 2)
    lower, upper = normalised_bounds(model, settings.mhe.bounds)
    return Windows(
        length=np.ones(n_episodes, dtype=np.int64),
        arrival_variance=np.ones((n_episodes, n)),
        predicted=np.zeros((*shape, n)),
        inputs=np.zeros((*shape, model.n_inputs)),
        process_variance=np.ones((*shape, n)),
        slopes=np.zeros((*shape, model.n_segments)),
        blocks=np.zeros((*shape, *model.road.neighbours.shape, 4)),
        by_factor=np.zeros((*shape, model.n_demand_states, 3)),
        offsets=np.zeros((*shape, n)),
        observed=np.zeros((*shape, n_channels), dtype=np.bool_),
        values=np.zeros((*shape, n_channels, 2)),
        noise=np.ones((*shape, n_channels, 2)),
        centre=np.zeros((*shape, model.n_segments)),
        weights=np.zeros((*shape, n_channels, 2, 2 * int(model.channels.span.max()))),
        targets=np.zeros((*shape, n_channels, 2)),
        solution=np.zeros((*shape, width)),
        active_set=np.zeros((*shape, width), dtype=np.int64),
        point=np.zeros((n_episodes, width)),
        solved=np.zeros(n_episodes, dtype=np.int64),
        fallback=fallback,
        moving_variance=moving_variance(model, settings),
        lower=lower,
        upper=upper,
        units=model.state_scale,
        along=settings.mhe.linearisation == "trajectory",
    )


# Shared with the reference ------------------------------------------------------------------------


def moving_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the arrival variances `(n_x,)` of a window that moves.

    They are those of `arrival_noise`, and for demand factors those of the prior: a window of the
    default length says less about a factor than its noise takes away, and an overconfident
    arrival keeps a wrong factor for many windows.
    """
    variance = initial_variance(model, settings)
    n = 2 * model.n_segments
    variance[:n] = np.tile(np.square(settings.mhe.arrival_noise), model.n_segments)
    return variance


def settings_of_mhe(settings: EstimatorSettings) -> EstimatorSettings:
    """Return the settings with the bounds of the MHE, which are separate from other estimators'."""
    return replace(settings, bounds=settings.mhe.bounds)


def normalised_bounds(model: ARZModel, bounds: Bounds) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest normalised state `(n_x,)` of the program."""
    share = model.jam_density / model.density_scale
    lower, upper = np.zeros(2 * model.n_segments), np.repeat(share, 2)
    if bounds == "cone":
        lower = np.tile([1.0, LEAST_W], model.n_segments) * LEAST_DENSITY / model.density_scale
        upper[1::2] *= LARGEST_W
    factors = np.ones(model.n_demand_states)
    return (
        np.concatenate([lower, LEAST_FACTOR * factors]),
        np.concatenate([upper, LARGEST_FACTOR * factors]),
    )
