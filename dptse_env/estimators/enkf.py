"""The ensemble Kalman filter, compiled, and weights of covariances by the distance along a road.

With D the deviations of outputs from their mean and X those of states, a member per column, the
update is `x += X D' (D D' + (M - 1) R)^-1 (z + noise - y)` for every member: S is factorised and
solved for the gain, which has fewer columns than there are members. Products of matrices use BLAS
and are small enough for one thread.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators.base import Estimate, KernelEstimator, Measurement
from dptse_env.estimators.ekf import (
    find_observed,
    initial_variance,
    process_noise,
    process_variance,
)
from dptse_env.estimators.linalg import factor, padded, solve_many
from dptse_env.estimators.normals import STREAM_WIDTH, Draws, draw, make_stream
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.arrays import ARZ
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    measure_channel,
    measured_speeds,
    project_states,
)
from dptse_env.model.parameters import LARGEST_W
from dptse_env.road import Road
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, kernel, kernel_part


class Ensembles(NamedTuple):
    """Members of n episodes and the parameters of their updates."""

    # (n, n_x, width) a member per column [veh/km, veh/h], with demand factors if there are any;
    # columns beyond the members are padding with copies of the first one
    members: FloatArray
    n_members: int
    priors: FloatArray  # (n, n_x) prior means
    streams: NDArray[np.uint64]  # (n, 2, 4, STREAM_WIDTH) of process noise and of measurement noise
    innovations: FloatArray  # (n, M, 2)
    diverged: BoolArray  # (n,)
    units: FloatArray  # (n_x,) of normalised components [veh/km, veh/h, 1]
    process_variance: FloatArray  # (n_x,) normalised, of a step; see `Filters`
    vehicle_variance: FloatArray  # (2,) normalised
    initial_deviation: FloatArray  # (n_x,) of the members around a prior [veh/km, veh/h, 1]
    density_scale: float  # rho_m [veh/km]
    inflation: float  # factor on distances from the mean before an update
    tapers: FloatArray  # (M, n_x) weights of covariances of channels with states; (0, 0) for none
    channel_tapers: FloatArray  # (M, M) weights of covariances among channels; (0, 0) for none
    is_box: bool  # whether members are projected into the paper's box, not the cone


# Weights of covariances ---------------------------------------------------------------------------


class Tapers(NamedTuple):
    """Weights of the covariances of M channels."""

    with_states: FloatArray  # (M, n_x) with the components of the state
    among_channels: FloatArray  # (M, M)


def make_tapers(model: ARZModel, reach: float) -> Tapers:
    """Return weights for the channels of a model, zero beyond a reach [km].

    A channel over several segments has the average weight of its segments, and a demand factor lies
    where its entry does. With T the weights between segments, W those of the segments in the
    channels and C the choice of a segment for each component, all weights are blocks of
    `[C; W] T [C; W]'`.
    Every segment has a position on a line, where the function is a correlation: T is positive
    semidefinite, hence the blocks, and so is their element-wise product with a covariance (Schur).
    Distances that include the ramps would not guarantee that.
    """
    x, weights = model.road.position, model.averaging
    by_segment = weights @ gaspari_cohn(np.abs(x[:, None] - x), reach)
    entries = model.road.entries[: model.n_demand_states]
    segments = np.concatenate([np.repeat(np.arange(model.n_segments), 2), entries])
    return Tapers(np.ascontiguousarray(by_segment[:, segments]), by_segment @ weights.T)


def gaspari_cohn(distance: FloatArray, reach: float) -> FloatArray:
    """Correlation with compact support (Gaspari and Cohn, 1999, eq. 4.10).

    A fifth-order piecewise rational function, close to a normal density in shape: 1 at distance 0,
    5/24 at half of `reach` > 0, 0 from `reach` on. Distances >= 0 have any shape.
    """
    z = 2.0 * np.asarray(distance, dtype=np.float64) / reach
    near = 1.0 + z**2 * (-5.0 / 3.0 + z * (5.0 / 8.0 + z * (0.5 - 0.25 * z)))
    away = np.clip(z, 1.0, 2.0)  # avoids a division by zero in the unused branch
    inner = 5.0 / 3.0 + away * (5.0 / 8.0 + away * (-0.5 + away / 12.0))
    far = 4.0 + away * (-5.0 + away * inner) - 2.0 / (3.0 * away)
    return np.where(z <= 1.0, near, np.where(z < 2.0, np.maximum(far, 0.0), 0.0))


# Kernels ------------------------------------------------------------------------------------------


@kernel
def restart(bundle: Bundle, episodes: IntArray) -> None:
    """Draw the members of episodes around their priors."""
    road, arz, _, ensembles = bundle.parts
    for e in episodes:
        _restart(road, arz, ensembles, e)


@kernel_part
def _restart(road: Road, arz: ARZ, ensembles: Ensembles, e: int) -> None:
    members, n = ensembles.members[e], ensembles.n_members
    for i in range(members.shape[0]):
        members[i] = ensembles.priors[e, i]
    draws = draw(ensembles.streams[e, 0], members.shape[0] * n)
    _perturb(members, n, ensembles.initial_deviation, np.empty(0), draws)
    project_states(road, arz, members, ensembles.is_box)


@kernel_part
def _perturb(
    members: FloatArray, n: int, deviation: FloatArray, slopes: FloatArray, draws: Draws
) -> None:
    """Add noise to the first n columns; those beyond repeat the first.

    Slopes, of psi's noise by rho's, are none or those of all segments [km/h].
    """
    for i in range(members.shape[0]):
        row, drawn, size = members[i], draws[i * n : (i + 1) * n], deviation[i]
        for j in range(n):
            row[j] += size * drawn[j]
        if i % 2 == 1 and i // 2 < slopes.size and slopes[i // 2] != 0.0:
            drawn, size = draws[(i - 1) * n : i * n], slopes[i // 2] * deviation[i - 1]
            for j in range(n):
                row[j] += size * drawn[j]
        row[n:] = row[0]


@kernel
def predict(bundle: Bundle, episodes: IntArray, inputs: FloatArray) -> None:
    """Predict members one step ahead under inputs `(k, n_u)`, with noise, and project them."""
    road, arz, _, ensembles = bundle.parts
    size, width = ensembles.members.shape[1:]
    scratch, n = make_batch_scratch(road, width), ensembles.n_members
    mean, variance, slopes = np.empty(size), np.empty(size), np.empty(road.n_segments)
    for k in range(episodes.size):
        members = ensembles.members[episodes[k]]
        for i in range(size):
            mean[i] = mean_of(members[i], n)
        process_noise(road, ensembles, mean, variance, slopes)
        advance_states(road, arz, members, inputs[k], scratch)
        draws = draw(ensembles.streams[episodes[k], 0], size * n)
        deviation = ensembles.units * np.sqrt(variance)
        _perturb(members, n, deviation, arz.free_flow_speed * slopes, draws)
        project_states(road, arz, members, ensembles.is_box)


@kernel
def update(bundle: Bundle, episodes: IntArray, measured: Measurement) -> None:
    """Update by measurements, perturbed for each member; see `Estimator.update`."""
    road, arz, channels, ensembles = bundle.parts
    indices = np.empty(channels.first.size, dtype=np.int64)
    for k in range(episodes.size):
        e, seen, sound = episodes[k], find_observed(measured.observed[k], indices), True
        ensembles.innovations[e] = 0.0
        members = ensembles.members[e]
        if seen.size > 0:
            sound = _assimilate(bundle, e, seen, measured, k)
            project_states(road, arz, members, ensembles.is_box)
        ensembles.diverged[e] = not (sound and is_finite(members))
        if ensembles.diverged[e]:
            ensembles.innovations[e] = 0.0
            _restart(road, arz, ensembles, e)


@kernel_part
def _assimilate(bundle: Bundle, e: int, seen: IntArray, measured: Measurement, k: int) -> bool:
    """Update the members of episode e, the k-th one that was measured, and write innovations.

    Args:
        bundle: Road, model, channels and `Ensembles`.
        e: The episode.
        seen: `(m,)` channels that are observed.
        measured: The measurement.
        k: Index of the episode in it.

    Returns:
        Whether S is definite and the members are finite, before a projection that would bring
        infinities back into the bounds.
    """
    road, arz, _, ensembles = bundle.parts
    members, n = ensembles.members[e], ensembles.n_members
    if ensembles.inflation != 1.0:
        _inflate(members, n, ensembles.inflation)
        project_states(road, arz, members, ensembles.is_box)
    size, width, n_states = 2 * seen.size, members.shape[1], members.shape[0]
    distances, residuals = np.empty((size, width)), np.empty((size, width))
    differences, noise = _compare(bundle, e, seen, measured, k, distances, residuals)
    states = np.zeros((padded(n_states), width))
    for i in range(n_states):
        _centre(members[i], n, 1.0, states[i])
    # S = D D' / (M - 1) + R and C = D X' / (M - 1) (Evensen, 2003), both tapered
    joint, gain = np.dot(distances, distances.T), np.dot(distances, states.T)
    if ensembles.tapers.size > 0:
        _taper(ensembles, seen, joint, gain)
    inverse = 1.0 / (n - 1)
    for i in range(size):
        for j in range(i):
            joint[i, j] *= inverse
        joint[i, i] = inverse * joint[i, i] + noise[i] ** 2
        innovation = differences[i] / np.sqrt(joint[i, i])
        ensembles.innovations[e, seen[i // 2], i % 2] = innovation
    if not factor(joint):
        return False
    # x = x + C' S^-1 (z + noise - y) for each member
    solve_many(joint, gain)
    shift = np.dot(gain.T, residuals)
    for i in range(n_states):
        row, step = members[i], shift[i]
        for j in range(width):
            row[j] += inverse * step[j]
    return is_finite(members)


@kernel_part
def _inflate(members: FloatArray, n: int, factor: float) -> None:
    for i in range(members.shape[0]):
        # x = m + factor (x - m) (Anderson and Anderson, 1999)
        row, mean = members[i], mean_of(members[i], n)
        for j in range(row.size):
            row[j] = mean + factor * (row[j] - mean)


@kernel_part(fastmath={"contract"})
def _compare(
    bundle: Bundle,
    e: int,
    seen: IntArray,
    measured: Measurement,
    k: int,
    distances: FloatArray,
    residuals: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Write deviations of outputs and residuals of members `(2 m, width)`, normalised.

    Returns:
        The residuals of the mean, and the deviations of the noise, `(2 m,)` each.
    """
    _, arz, channels, ensembles = bundle.parts
    values, sigma, centre = measured.values[k], measured.sigma[k], measured.centre[k]
    members, n = ensembles.members[e], ensembles.n_members
    units = np.array([ensembles.density_scale, arz.second_scale])
    differences, noise = np.empty(2 * seen.size), np.empty(2 * seen.size)
    outputs, work = np.empty((2, members.shape[1])), np.empty(members.shape[1])
    draws = draw(ensembles.streams[e, 1], differences.size * n)
    for r in range(differences.size):
        m, kind = seen[r // 2], r % 2
        if kind == 0:
            measure_channel(arz, channels, m, members, centre, outputs[0], outputs[1], work)
        distance, residual, drawn = distances[r], residuals[r], draws[r * n : (r + 1) * n]
        mean = _centre(outputs[kind], n, units[kind], distance)
        size = sigma[m, kind] / units[kind]
        difference = values[m, kind] / units[kind] - mean
        for j in range(n):  # z + noise - y (Burgers et al., 1998)
            residual[j] = difference + size * drawn[j] - distance[j]
        residual[n:] = 0.0
        differences[r], noise[r] = difference, size
    return differences, noise


@kernel_part
def _taper(ensembles: Ensembles, seen: IntArray, joint: FloatArray, gain: FloatArray) -> None:
    """Weigh covariances among outputs, and those with the states, by distance."""
    for i in range(joint.shape[0]):
        among, weights = ensembles.channel_tapers[seen[i // 2]], ensembles.tapers[seen[i // 2]]
        for j in range(joint.shape[1]):
            joint[i, j] *= among[seen[j // 2]]
        for j in range(weights.size):
            gain[i, j] *= weights[j]


@kernel
def summarise(bundle: Bundle, out: FloatArray) -> None:
    """Write density and speed of the mean and the deviations of members to `out` `(4, n, S)`."""
    road, arz, _, ensembles = bundle.parts
    members, n = ensembles.members, ensembles.n_members
    v_f, gamma, width = arz.free_flow_speed, arz.gamma, members.shape[2]
    speed, mean = np.empty(width), np.empty((3, 1))
    for e in range(members.shape[0]):
        for s in range(road.n_segments):
            rho, psi = members[e, 2 * s], members[e, 2 * s + 1]
            mean[0, 0], out[2, e, s] = _moments(rho, n)
            mean[1, 0] = mean_of(psi, n)
            measured_speeds(mean[0], mean[1], arz.jam[s], v_f, gamma, mean[2])
            measured_speeds(rho, psi, arz.jam[s], v_f, gamma, speed)
            _, out[3, e, s] = _moments(speed, n)
            out[0, e, s] = min(mean[0, 0], arz.jam[s])
            out[1, e, s] = min(max(mean[2, 0], 0.0), LARGEST_W * v_f)


@kernel_part(fastmath={"contract", "reassoc"})
def mean_of(row: FloatArray, n: int) -> float:
    """Return the mean of the first n relative to the first, exact for equal numbers."""
    first, total = row[0], 0.0
    for j in range(n):
        total += row[j] - first
    return float(first + total / n)


@kernel_part(fastmath={"contract", "reassoc"})
def _moments(row: FloatArray, n: int) -> tuple[float, float]:
    """Return mean and standard deviation of the first n."""
    mean, total = mean_of(row, n), 0.0
    for j in range(n):
        total += (row[j] - mean) ** 2
    return mean, np.sqrt(total / (n - 1))


@kernel_part
def _centre(row: FloatArray, n: int, unit: float, out: FloatArray) -> float:
    """Write distances from the mean, zero beyond n, and return the mean, both over `unit`."""
    mean, inverse = mean_of(row, n), 1.0 / unit
    for j in range(n):
        out[j] = (row[j] - mean) * inverse
    out[n:] = 0.0
    return mean * inverse


@kernel_part(fastmath={"contract", "reassoc"})
def is_finite(matrix: FloatArray) -> bool:
    """Return whether all numbers of a matrix are finite."""
    total = 0.0
    for i in range(matrix.shape[0]):
        row = matrix[i]
        for j in range(row.size):
            total += 0.0 * row[j]
    return total == 0.0


class EnKF(KernelEstimator):
    """Ensemble Kalman filter with perturbed observations (Evensen, 2003; Burgers et al., 1998).

    Every member is predicted, perturbed by process noise and projected; updated by perturbed
    measurements; and projected again. Each episode has separate streams, seeded by the generator
    given to `reset`, for process and for measurement noise, so that the measurements do not change
    the process noise.

    Options, off by default (`EnsembleSettings`): `inflation` moves members away from their mean
    before every update that has measurements, and projects them; `taper` weighs the sampled
    covariances by distance, those of outputs with states and those among outputs. An S with
    covariances that the gain neglects would give the measurements too little weight.

    The noise that depends on the density, that of vehicles and flicker, has the variance at the
    ensemble's mean for all members.
    """

    reads_flicker = True
    predict_kernel = staticmethod(predict)
    update_kernel = staticmethod(update)

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        nothing = np.zeros((n_episodes, model.n_segments))
        priors = model.project(model.compose(nothing, nothing), settings.bounds)
        taper, none = settings.enkf.taper, np.empty((0, 0))
        weights = Tapers(none, none) if taper is None else make_tapers(model, taper)
        self.n_members = settings.enkf.n_members
        self._ensembles = Ensembles(
            members=np.repeat(priors[:, :, None], padded(self.n_members), axis=2),
            n_members=self.n_members,
            priors=priors,
            streams=np.empty((n_episodes, 2, 4, STREAM_WIDTH), dtype=np.uint64),
            innovations=self.innovations,
            diverged=self.diverged,
            units=model.state_scale,
            process_variance=process_variance(model, settings),
            vehicle_variance=np.square(settings.vehicle_noise),
            initial_deviation=np.sqrt(initial_variance(model, settings)) * model.state_scale,
            density_scale=model.density_scale,
            inflation=settings.enkf.inflation,
            tapers=weights.with_states,
            channel_tapers=weights.among_channels,
            is_box=settings.bounds == "box",
        )
        self.arrays = Bundle(*model.dynamics, self._ensembles)
        self._seed(np.arange(n_episodes), [np.random.default_rng(0)] * n_episodes)

    @property
    def members(self) -> FloatArray:
        """Members `(n, n_members, n_x)` [veh/km, veh/h], then demand factors if any; a copy."""
        return np.ascontiguousarray(self._inner.swapaxes(1, 2))

    @property
    def states(self) -> FloatArray:
        """Means of the members `(n, n_x)` [veh/km, veh/h], then demand factors if any."""
        return np.asarray(self._inner.mean(axis=2))

    @property
    def covariances(self) -> FloatArray:
        """Sample covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f."""
        rest = self._inner - self.states[:, :, None]
        rest /= self.model.state_scale[:, None]
        product = rest @ rest.swapaxes(1, 2) / (self.n_members - 1)
        return np.asarray(0.5 * (product + product.swapaxes(1, 2)))

    @property
    def _inner(self) -> FloatArray:
        """Members `(n, n_x, n_members)` without padding."""
        return self._ensembles.members[:, :, : self.n_members]

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return self._ensembles.members, self._ensembles.priors, self._ensembles.streams

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._ensembles.priors[episodes] = self.model.project(states, self.settings.bounds)
        self._seed(episodes, generators)
        restart(self.arrays, episodes)

    def _means_of(self, episodes: IntArray) -> FloatArray:
        return np.asarray(self._inner[episodes].mean(axis=2))

    def _seed(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Seed the streams of process noise and of measurement noise."""
        for episode, generator in zip(episodes.tolist(), generators, strict=True):
            for kind in range(2):
                self._ensembles.streams[episode, kind] = make_stream(generator)

    def _estimate(self) -> Estimate:
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        summarise(self.arrays, out)
        return Estimate(*out)
