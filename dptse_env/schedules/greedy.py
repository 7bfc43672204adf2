"""A schedule on a covariance of the estimator's errors, which is public, unlike the truth.

Kernels treat episodes one by one. States are normalised: rho by rho_m, psi by rho_m v_f.
"""

from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.estimators.linalg import mirror, padded, pair_update, propagate
from dptse_env.model.arrays import ARZ, Channels
from dptse_env.model.step import (
    advance,
    floored_speed,
    make_scratch,
    normalise,
    project,
    write_channel,
)
from dptse_env.process import QueryProcess
from dptse_env.road import Road
from dptse_env.schedules import ProcessSchedule, require_plain
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.kernels import Bundle, copy_matrix, copy_vector, kernel, kernel_part


class Design(NamedTuple):
    """Constants of a road, its releases and the reward, for compiled code."""

    bandwidth: int  # B
    always: IntArray  # (F,) segments with a fixed sensor
    can_query: IntArray  # (A,) mainline segments without a fixed sensor
    units: FloatArray  # (2 S,) of normalised states [veh/km, veh/h]
    centre: FloatArray  # (S,) v_0 of released flows [km/h], NaN where speeds are released
    noise: FloatArray  # (2,) variances R of both numbers of a release, normalised
    process_variance: FloatArray  # (2 S,) of a step
    is_walk: bool  # whether the estimator is a random walk
    is_box: bool  # whether means are projected into the box, not the cone
    lengths: FloatArray  # (n,) of mainline segments [km]
    scales: FloatArray  # (2,) of the reward [veh/km, km/h]
    speed_unit: float  # v_f [km/h]
    term_weights: FloatArray  # (2,) of density and speed in the reward
    speed_cap: float  # in the reward's units


class GreedyTrace(ProcessSchedule):
    """Greedy design: segments chosen in turn, each the most informative given those before.

    The covariance P of the state is predicted to the coming second, ``P = F P F' + Q`` with the
    Jacobian F of the model at the present estimate, and updated by the fixed sensors. A query of
    segment s, with its two rows H_s and the noise R, reduces it by
    ``P H_s' (H_s P H_s' + R)^-1 H_s P``. The most informative segment has the largest weighted
    trace of that reduction (A-optimal design), over the variances of density and speed of the
    mainline in the reward's units. The choice updates P, and so on.

    A density has the weight 1. A speed has the probability that the segment has a vehicle,
    ``1 - exp(-rho l)``, since an empty segment has no speed error, times
    ``min(1, speed_cap^2 / variance)``: a variance counts up to the square of the cap. Errors that
    are not in the reward have no weight.

    P is not the estimator's, although it begins there with an episode: a filter that is
    overconfident about segments without recent measurements would keep its errors there. A larger
    process noise lets variances grow within seconds, and the cap limits the weight of the speeds of
    nearly empty segments. Both were selected on validation traffic among values that differ from
    them by factors of three.

    For an estimator that is a random walk, F is the identity and Q that of density and speed. A
    step costs B updates of the EKF's covariance and n gains for each, about 1.5 EKF steps at
    n = 15, B = 5.

    Attributes:
        process_noise: Standard deviations of the process noise of a step, of rho over rho_m and of
            psi over rho_m v_f; of a random walk, of v over v_f in its place.
        speed_cap: Standard deviation of a speed beyond which it does not count, in the reward's
            units.
    """

    name: ClassVar[str] = "greedy-trace"
    process_noise: ClassVar[tuple[float, float]] = (0.1, 0.03)
    speed_cap: ClassVar[float] = 0.1

    def __init__(self, process: QueryProcess, seed: int | None = None) -> None:
        """Bind the schedule to a process (``env.unwrapped.process``).

        Raises:
            ValueError: The estimator has no covariance, or queries are not the mainline segments.
        """
        super().__init__(process, seed)
        require_plain(process.interface, self.name)
        if not hasattr(type(process.estimator), "covariances"):
            raise ValueError(
                f"schedule {self.name!r} needs an estimator with a covariance, "
                f"{process.config.estimator!r} has none"
            )
        self._estimator: Any = process.estimator
        road, arz, _ = process.model.dynamics
        channels = Channels.of_segments(road)
        self._bundle = Bundle(road, arz, channels, self._make_design())
        n = 2 * road.n_segments
        self._before = np.zeros((process.n_episodes, n, padded(n)))
        self._after = self._before.copy()
        self._second = np.full(process.n_episodes, -1)

    def _make_design(self) -> Design:
        process, model = self.process, self.process.model
        config, corridor, n = process.config, process.config.corridor, self.n_mainline
        settings, term = config.settings(), process.interface.reward.term
        sigma = np.array(settings.noise_scale) * process.expected_sigma / model.measurement_scale
        centre = np.nan if model.centre is None else model.centre
        always = np.array(sorted(corridor.fixed_sensors), dtype=np.int64)
        return Design(
            bandwidth=self.bandwidth,
            always=always,
            can_query=np.setdiff1d(np.arange(n), always),
            units=model.state_scale[: 2 * model.n_segments],
            centre=np.full(model.n_segments, centre),
            noise=sigma**2,
            process_variance=np.tile(np.square(self.process_noise), model.n_segments),
            is_walk=config.estimator == "random_walk",
            is_box=settings.bounds == "box",
            lengths=model.road.lengths[:n],
            scales=np.array([corridor.scales.density_scale, corridor.scales.speed_scale]),
            speed_unit=float(model.speed_scale),
            term_weights=np.array([term != "speed", term != "density"], dtype=np.float64),
            speed_cap=self.speed_cap,
        )

    def _choose(self, episodes: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        process = self.process
        self._begin(episodes)
        traffic, times = process.traffic_index[episodes], process.time[episodes]
        inputs = np.ascontiguousarray(process.boundary.inputs(episodes, traffic, times))
        means = np.ascontiguousarray(self._estimator.states[episodes, : self._before.shape[1]])
        queried = np.zeros((len(episodes), self.n_mainline), dtype=bool)
        covariances = self._before, self._after
        choose(self._bundle, episodes, means, inputs, *covariances, queried)
        return queried

    def _begin(self, episodes: IntArray) -> None:
        """Let the covariances before the coming second be those after the last one.

        A repeated call in the same second starts from the same covariance; after a second without
        a call, as after a reset, the estimator's is the start.
        """
        second = self.process.elapsed[episodes]
        is_next = second == self._second[episodes] + 1
        self._before[episodes[is_next]] = self._after[episodes[is_next]]
        is_new = (second == 0) | ~(is_next | (second == self._second[episodes]))
        if is_new.any():
            n = self._before.shape[1]
            new = episodes[is_new]
            self._before[new, :, :n] = self._estimator.covariances[new, :n, :n]
        self._second[episodes] = second


class Work(NamedTuple):
    """Scratch space of an episode, with what is linearised at its predicted mean."""

    mean: FloatArray  # (2 S,) predicted state [veh/km, veh/h]
    blocks: FloatArray  # (S, K, 4) blocks of F
    square: FloatArray  # (2, 2 S, padded)
    rows: FloatArray  # (S, 2, 2) H_s, derivatives of both released numbers by rho and psi
    to_speed: FloatArray  # (S, 2) derivatives of a speed over v_f by rho and psi
    # (n, 3) a segment's weights of the variance of rho, of the covariance of rho and psi, and of
    # the variance of psi in the trace
    weights: FloatArray
    columns: FloatArray  # (4, padded)
    constants: FloatArray  # (2,)


@kernel
def choose(
    bundle: Bundle,
    episodes: IntArray,
    means: FloatArray,
    inputs: FloatArray,
    before: FloatArray,
    after: FloatArray,
    queried: BoolArray,
) -> None:
    """Choose segments in turn, for k episodes.

    Args:
        bundle: Road, model and a channel for each segment; the `Design`.
        episodes: Shape (k,).
        means: Present states, shape (k, 2 S) [veh/km, veh/h].
        inputs: The model's inputs of the coming second, shape (k, n_u).
        before: Present covariances, shape (n, 2 S, padded).
        after: Output, those after the coming second.
        queried: Output, shape (k, n), all False.
    """
    road, arz, channels, design = bundle.parts
    s, width = road.n_segments, before.shape[2]
    scratch, square = make_scratch(road), np.empty((2, 2 * s, width))
    columns = np.empty((4, width))
    work = Work(
        np.empty(2 * s), np.empty((*road.neighbours.shape, 4)), square, np.empty((s, 2, 2)),
        np.empty((s, 2)), np.empty((queried.shape[1], 3)), columns, np.empty(2),
    )  # fmt: skip
    for k in range(means.shape[0]):
        covariance = after[episodes[k]]
        copy_matrix(before[episodes[k]], covariance)
        copy_vector(means[k], work.mean)
        if not design.is_walk:
            advance(road, arz, work.mean, inputs[k], work.mean, work.blocks, scratch)
            project(road, arz, work.mean, design.is_box)
        _linearise(road, arz, channels, design, work)
        if design.is_walk:
            _drift(design, covariance, work.to_speed)
        else:
            no_factors, no_slopes = np.empty((0, 2)), np.empty(0)
            normalise(arz, design.units[0], work.blocks, no_factors)
            noise = design.process_variance
            propagate(
                road, work.blocks, no_factors, noise, no_slopes, covariance, work.square, covariance
            )
            mirror(covariance)
        for segment in design.always:
            _update(design, covariance, segment, work)
        _weigh(design, covariance, work)
        for _ in range(min(design.bandwidth, design.can_query.size)):
            best = _most_informative(design, covariance, work, queried[k])
            queried[k, best] = True
            _update(design, covariance, best, work)
        _fill_up(design.bandwidth - design.can_query.size, queried[k])


@kernel_part
def _linearise(road: Road, arz: ARZ, channels: Channels, design: Design, work: Work) -> None:
    """Linearise what is released, and speeds, at the predicted mean."""
    mean, v_f = work.mean, design.speed_unit
    for s in range(road.n_segments):
        write_channel(
            arz, channels, design.units, mean, design.centre, s, work.rows[s], work.constants
        )
        rho, psi = mean[2 * s], mean[2 * s + 1]
        _, by_rho, by_psi = floored_speed(rho, psi, arz.jam[s], arz.free_flow_speed, arz.gamma)
        work.to_speed[s, 0] = by_rho * design.units[2 * s] / v_f
        work.to_speed[s, 1] = by_psi * design.units[2 * s + 1] / v_f


@kernel_part
def _drift(design: Design, covariance: FloatArray, to_speed: FloatArray) -> None:
    """Add T^-1 Q T^-T to each segment's block, T = [[1, 0], [p, q]] from states to traffic."""
    a, b = design.process_variance[0], design.process_variance[1]
    for s in range(to_speed.shape[0]):
        p, q = to_speed[s, 0], to_speed[s, 1]
        covariance[2 * s, 2 * s] += a
        covariance[2 * s, 2 * s + 1] -= p / q * a
        covariance[2 * s + 1, 2 * s] -= p / q * a
        covariance[2 * s + 1, 2 * s + 1] += (b + p * p * a) / (q * q)


@kernel_part
def _update(design: Design, covariance: FloatArray, s: int, work: Work) -> None:
    """Update a covariance by a segment's release; one that is not sound is left as it is."""
    if pair_update(covariance, 2 * s, work.rows[s], design.noise, work.columns):
        mirror(covariance)


@kernel_part
def _weigh(design: Design, covariance: FloatArray, work: Work) -> None:
    """Write the weights of the trace, given the covariance before any query."""
    of_density = design.term_weights[0] * (design.units[0] / design.scales[0]) ** 2
    speed_scale = (design.speed_unit / design.scales[1]) ** 2
    for s in range(work.weights.shape[0]):
        p, q = work.to_speed[s, 0], work.to_speed[s, 1]
        variance = p * p * covariance[2 * s, 2 * s] + 2.0 * p * q * covariance[2 * s, 2 * s + 1]
        variance += q * q * covariance[2 * s + 1, 2 * s + 1]
        occupied = 1.0 - np.exp(-design.lengths[s] * work.mean[2 * s])
        held = min(1.0, design.speed_cap**2 / (speed_scale * variance))
        of_speed = design.term_weights[1] * speed_scale * occupied * held
        work.weights[s, 0] = of_density + of_speed * p * p
        work.weights[s, 1] = of_speed * p * q
        work.weights[s, 2] = of_speed * q * q


@kernel_part
def _most_informative(
    design: Design, covariance: FloatArray, work: Work, queried: BoolArray
) -> int:
    """Return the segment of the largest gain that is not queried yet."""
    best, largest = -1, -np.inf
    for s in design.can_query:
        if not queried[s]:
            gain = _gain(covariance, s, work.rows[s], design.noise, work.weights)
            if gain > largest or best < 0:
                best, largest = s, gain
    return best


@kernel_part(fastmath={"contract", "reassoc"})
def _gain(
    covariance: FloatArray, s: int, row: FloatArray, noise: FloatArray, weights: FloatArray
) -> float:
    """Return by how much a query of a segment reduces the weighted trace.

    That is the trace of S^-1 G with ``S = H P H' + R`` and ``G = H P W P H'``, W the weights.
    """
    upper, lower = covariance[2 * s], covariance[2 * s + 1]
    xx = xy = yy = 0.0
    for t in range(weights.shape[0]):
        a, b, c, d = upper[2 * t], upper[2 * t + 1], lower[2 * t], lower[2 * t + 1]
        u, v, w = weights[t, 0], weights[t, 1], weights[t, 2]
        e, f = u * a + v * b, v * a + w * b
        xx += e * a + f * b
        xy += e * c + f * d
        yy += (u * c + 2.0 * v * d) * c + w * d * d
    s11, s12, s22 = _form(row, upper[2 * s], upper[2 * s + 1], lower[2 * s + 1])
    g11, g12, g22 = _form(row, xx, xy, yy)
    s11, s22 = s11 + noise[0], s22 + noise[1]
    ratio = s12 / s11
    left = s22 - s12 * ratio
    return float(g11 / s11 + (g22 - 2.0 * ratio * g12 + ratio * ratio * g11) / left)


@kernel_part
def _form(row: FloatArray, xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """Return the three entries of H M H', for a symmetric M (2, 2) of three entries."""
    a, b, c, d = row[0, 0], row[0, 1], row[1, 0], row[1, 1]
    first, second = a * xx + b * xy, a * xy + b * yy
    third, fourth = c * xx + d * xy, c * xy + d * yy
    return first * a + second * b, first * c + second * d, third * c + fourth * d


@kernel_part
def _fill_up(n_left: int, queried: BoolArray) -> None:
    """Use remaining bandwidth on segments with a fixed sensor, without gain."""
    for s in range(queried.size):
        if n_left > 0 and not queried[s]:
            queried[s] = True
            n_left -= 1
