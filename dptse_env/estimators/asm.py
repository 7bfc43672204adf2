"""Adaptive smoothing (Treiber and Helbing, 2002), causal: a kernel mean of what was released.

For a place x and the present second t, over released values z_j of places x_j and seconds t_j up to
t, two means are taken, one along the waves of free traffic and one along those of congested
traffic, c = c_free > 0 and c = -c_jam < 0:

    z_c(x) = sum_j w_j phi_c z_j / sum_j w_j phi_c
    phi_c = exp(-|x_j - x| / s - |t_j - t - (x_j - x) / c| / tau)

The kernels are the same for densities and speeds. A value whose noise has the variance V_j weighs
w_j = `TRUSTED` / (`TRUSTED` + V_j), a density and its speed each for itself. The weights of both
means depend on the slower of their speeds, m = (1 + tanh((V - v) / dV)) / 2 with
v = min(v_free, v_jam):

    z(x) = m z_jam(x) + (1 - m) z_free(x)

Densities are smoothed per lane, along the mainline and along each ramp for itself: smoothed into
each other, errors of the mainline are up to a half larger. A released flow becomes a speed,
centre + flow / density, by the density estimated before it; where that is below
`LEAST_LANE_DENSITY`, vehicles at the speed limit are added up to it. Neighbours further away than
`REACH` s are left out.
What the model's inputs say of the ends of the road are values as well, half a segment beyond it:
behind an exit drivers keep their w = v + p(rho). The prior is a value of second 0.

Sums over all seconds take no history of releases. With the decay r = exp(-1 / tau) of a step and
P_t = r P_{t-1} + w_t z_t, the sum of a place over the seconds of all ages a with a wave that takes
L to arrive, f = floor(L), is

    sum_a exp(-|a - L| / tau) w_{t-a} z_{t-a} = exp(-L / tau) P_t
        + exp(-(L - f) / tau) sum_{a=1..f} (1 - r^2) r^{f-a} P_{t-a}
        + (exp(-(f + 1 - L) / tau) - r exp(-(L - f) / tau)) P_{t-f-1}

Deviations: the noise carried through the kernel, with both means as if perfectly correlated, and
what the mean smooths away, in the variance

    k_1 (a_1 n^(1/2) / l^2 + a_2 (rho_jam - rho_free)^2)      of densities,
    k_2 (b_1 / (1 + n) + b_2 (v_jam - v_free)^2)              of speeds.

With n = rho l vehicles in a segment, their number varies less than that of a Poisson process, and
their mean speed the less the more they are. The coefficients are fitted to training traffic of the
package's roads. The factors k of a segment follow its innovations e, of variance noise + k M, in a
memory that fades:

    k = (K + sum M (e^2 - noise) / (noise + M)^2) / (K + sum M^2 / (noise + M)^2)

clipped to 1 to 10: they stay at 1 where noise hides what is smoothed away. Where the last release
within reach is of A seconds ago the variances c_1 lanes^2 and c_2 are added, times
(A / (A + `STALE`))^2: inputs alone say little of a ramp with a queue.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dptse_env.estimators.base import Measurement, SegmentEstimator
from dptse_env.estimators.settings import AdaptiveSmoothingSettings, EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.arrays import ARZ, Channels
from dptse_env.model.step import pressure
from dptse_env.road import Road
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, all_finite, inline_part, kernel, kernel_part
from dptse_env.utils.units import HOUR

REACH = 3.0
"""Distance of the furthest neighbours, in s: they weigh a twentieth of the place itself."""
LEAST_LANE_DENSITY = 15.0
"""Density of a lane [veh/km] below which a flow is mostly noise."""
LEAST_WEIGHT = 1e-100
FREE, JAM = 0, 1
WEIGHT, VALUE, NOISE = 0, 2, 4
"""Sums of densities, and of speeds each one further on: of weights, of weights times values, and
of squared weights times variances of noise."""
TRUSTED = 30.0**2, 50.0**2
"""Variances of the noise of a lane's density [(veh/km)^2] and of a speed [(km/h)^2] with which a
value weighs half of one without noise."""
DENSITY_MODEL = 0.8, 0.5
SPEED_MODEL = 310.0, 0.4
"""Coefficients a [veh^(3/2), 1] and b [(km/h)^2, 1] of the variance that is smoothed away."""
STALE_VARIANCE = 30.0**2, 40.0**2
"""Coefficients c [(veh/km)^2, (km/h)^2]: variances of traffic that nothing is known of."""
STALE = 60.0
FACTOR_MEMORY, CONFIDENCE = 300.0, 0.3
"""Seconds in which the factors forget, and K: how many innovations without noise k = 1 is worth."""
LARGEST_FACTOR = 10.0
"""Range of the factors from 1 on: calm traffic does not make the next jam known."""


class Stencil(NamedTuple):
    """Weights of the values at J places, S segments and then the ends of the road."""

    target: IntArray  # (Q,) segments that values count for, by place, then by delay
    wave: IntArray  # (Q,) FREE or JAM
    delay: IntArray  # (Q,) f, whole steps that the wave takes to arrive
    weight: FloatArray  # (Q, 2, 3) factors of P_t, the sum and P_{t-f-1}; and for squared weights
    first: IntArray  # (J + 1,) where the entries of each place begin
    flows: bool  # whether flows are released, otherwise speeds
    decay: float  # r
    threshold: float  # V
    transition: float  # dV
    largest_speed: float
    step: float  # [s]
    forgetting: float  # of the factors in a step
    boundary_weight: float  # of what the model's inputs say of the ends


class State(NamedTuple):
    """The sums and estimates of n episodes."""

    past: FloatArray  # (n, J, H, 6) P of the last H steps, each in turn
    place: IntArray  # (n,) where the present one is
    sums: FloatArray  # (n, S, 2, 6) of both waves
    present: FloatArray  # (n, S, 4) density, speed and their deviations
    priors: FloatArray  # (n, S, 4)
    smoothed: FloatArray  # (n, S, 2) variances of what is smoothed away, without their factors
    age: FloatArray  # (n, S) seconds since the last release within reach
    evidence: FloatArray  # (n, S, 2, 2) sums of the factors' numerators and denominators
    innovations: FloatArray  # (n, M, 2)
    diverged: BoolArray  # (n,)


def make_stencil(model: ARZModel, settings: AdaptiveSmoothingSettings) -> Stencil:
    """Return what the values of each place count for."""
    step = model.time_step
    lines: list[tuple[int, int, int, list[list[float]]]] = []
    first = [0]
    for reached in neighbours(model, REACH * settings.length):
        found = []
        for target, distance in reached.items():
            spatial = math.exp(-abs(distance) / settings.length)
            for wave, speed in ((FREE, settings.free_wave), (JAM, -settings.jam_wave)):
                # A wave arrives late downstream of the place if it is free, else upstream.
                lag = HOUR * distance / speed
                if lag > 0.0:
                    factors = _factors(lag, settings.time, step, spatial)
                    found.append((int(lag / step), target, wave, factors))
                else:
                    weight = spatial * math.exp(lag / settings.time)
                    found.append((0, target, wave, [[weight, 0.0, 0.0], [weight**2, 0.0, 0.0]]))
        found.sort(key=lambda entry: entry[:3])
        lines += found
        first.append(len(lines))
    delay, target, wave = np.array([line[:3] for line in lines], dtype=np.int64).T.copy()
    return Stencil(
        target=target,
        wave=wave,
        delay=delay,
        weight=np.array([line[3] for line in lines]),
        first=np.array(first, dtype=np.int64),
        flows=model.releases_flow,
        decay=math.exp(-step / settings.time),
        threshold=float(settings.threshold),
        transition=float(settings.transition),
        largest_speed=float(model.largest_speed),
        step=float(step),
        forgetting=math.exp(-step / FACTOR_MEMORY),
        boundary_weight=float(settings.boundary_weight),
    )


def _factors(lag: float, time: float, step: float, spatial: float) -> list[list[float]]:
    """Return the factors of a wave that arrives after `lag` [s], of weights and their squares."""
    whole, found = int(lag / step), []
    for tau, base in ((time, spatial), (time / 2.0, spatial**2)):
        rest = math.exp(-(lag - whole * step) / tau)
        next_one = math.exp(-((whole + 1) * step - lag) / tau)
        found.append(
            [
                base * math.exp(-lag / tau),
                base * rest,
                base * (next_one - math.exp(-step / tau) * rest),
            ]
        )
    return found


def neighbours(model: ARZModel, reach: float) -> Iterator[dict[int, float]]:
    """Yield the segments within reach of each segment and then each end, entries before exits.

    Along the mainline, or along the same ramp. An end is half a segment beyond the road.

    Yields:
        Distances [km] of segments by index: positive downstream.
    """
    road = model.road
    centre, stretches = np.empty(road.n_segments), {}
    for stretch in np.unique(road.stretch).tolist():
        segments = np.flatnonzero(road.stretch == stretch)
        lengths = road.lengths[segments]
        centre[segments] = np.cumsum(lengths) - 0.5 * lengths
        stretches[stretch] = segments.tolist()
    places = [(s, centre[s]) for s in range(road.n_segments)]
    places += [(s, centre[s] - road.lengths[s]) for s in road.entries.tolist()]
    places += [(s, centre[s] + road.lengths[s]) for s in road.exits.tolist()]
    for segment, x in places:
        distances = {s: float(centre[s] - x) for s in stretches[int(road.stretch[segment])]}
        yield {s: d for s, d in distances.items() if abs(d) <= reach}


@kernel
def restart(bundle: Bundle, episodes: IntArray) -> None:
    """Begin episodes `(k,)` with their priors as the values of a second."""
    road, _, _, _, state = bundle.parts
    for e in episodes:
        _restart(road, state, e)


@kernel_part
def _restart(road: Road, state: State, e: int) -> None:
    past, prior = state.past[e], state.priors[e]
    past[:] = 0.0
    state.place[e] = 0
    state.evidence[e] = CONFIDENCE
    state.age[e] = 0.0
    state.innovations[e] = 0.0
    for s in range(road.n_segments):
        lanes, known = road.lanes[s], past[s, 0]
        _weigh(0, 1.0, prior[s, 0] / lanes, (prior[s, 2] / lanes) ** 2, known)
        _weigh(1, 1.0, prior[s, 1], prior[s, 3] ** 2, known)
        for j in range(4):
            state.present[e, s, j] = prior[s, j]
        state.smoothed[e, s] = 0.0


@kernel
def predict(bundle: Bundle, episodes: IntArray, inputs: FloatArray) -> None:
    """Let values age by a step, and add what inputs `(k, n_u)` say of the ends."""
    road, arz, _, stencil, state = bundle.parts
    for k in range(episodes.size):
        e = episodes[k]
        past, present = state.past[e], state.present[e]
        before, H = state.place[e], past.shape[1]
        place = before + 1 if before + 1 < H else 0
        state.place[e] = place
        for j in range(past.shape[0]):
            old, new = past[j, before], past[j, place]
            for i in range(2):
                # Stop decaying before the weight underflows, so that the last mean is kept.
                r = stencil.decay if old[WEIGHT + i] > LEAST_WEIGHT else 1.0
                new[WEIGHT + i] = r * old[WEIGHT + i]
                new[VALUE + i] = r * old[VALUE + i]
                new[NOISE + i] = r * r * old[NOISE + i]
        if stencil.boundary_weight > 0.0:
            _read_ends(road, arz, stencil, inputs[k], present, past, place)
        for s in range(road.n_segments):
            state.age[e, s] += stencil.step
            for i in range(2):
                for j in range(2):
                    # Evidence fades towards none, which is the factor 1.
                    kept = state.evidence[e, s, i, j] - CONFIDENCE
                    state.evidence[e, s, i, j] = CONFIDENCE + stencil.forgetting * kept
        _sum(stencil, past, place, state.sums[e])
        _evaluate(road, arz, stencil, state, e)


@inline_part
def _read_ends(
    road: Road,
    arz: ARZ,
    stencil: Stencil,
    inputs: FloatArray,
    present: FloatArray,
    past: FloatArray,
    place: int,
) -> None:
    """Add the values of the ends."""
    v_f, gamma, weight = arz.free_flow_speed, arz.gamma, stencil.boundary_weight
    S, jam = road.n_segments, arz.jam
    for b in range(road.entries.size):
        column, cell = road.entry_inputs[b], road.entry_cells[b]
        w = inputs[column + 1]
        rho = entry_density(inputs[column], w, v_f, gamma, jam[cell])
        new = past[S + b, place]
        _weigh(0, weight, rho / road.lanes[cell], 0.0, new)
        _weigh(1, weight, w - pressure(rho, jam[cell], v_f, gamma), 0.0, new)
    for b in range(road.exits.size):
        s, cell, rho = road.exits[b], road.exit_cells[b], inputs[road.exit_inputs[b]]
        w = present[s, 1] + pressure(present[s, 0], jam[s], v_f, gamma)
        new = past[S + road.entries.size + b, place]
        _weigh(0, weight, rho / road.lanes[cell], 0.0, new)
        _weigh(1, weight, max(w - pressure(rho, jam[cell], v_f, gamma), 0.0), 0.0, new)


@inline_part
def _weigh(i: int, weight: float, value: float, noise: float, sums: FloatArray) -> None:
    """Add a density (i = 0) or a speed (1), whose noise has a variance, to the sums of a place.

    It counts as `weight` independent values of this variance.
    """
    trust = TRUSTED[i] / (TRUSTED[i] + noise)
    sums[WEIGHT + i] += weight * trust
    sums[VALUE + i] += weight * trust * value
    sums[NOISE + i] += weight * trust**2 * noise


@kernel_part
def entry_density(demand: float, w: float, v_f: float, gamma: float, jam: float) -> float:
    """Return the density [veh/km] at which drivers of some w send a demand [veh/h] freely.

    The smaller root of rho (w - p(rho)) = demand, by Newton's method from below, where the function
    is concave; the critical density where the demand is the largest that they can send.
    """
    critical: float = jam * (max(w, 0.0) / ((1.0 + gamma) * v_f)) ** (1.0 / gamma)
    if demand >= (1.0 - 1e-9) * critical * w * gamma / (1.0 + gamma):
        return critical
    rho = demand / w
    for _ in range(60):
        p = pressure(rho, jam, v_f, gamma)
        change = (demand - rho * (w - p)) / (w - (1.0 + gamma) * p)
        rho += change
        if change <= 1e-12 * rho:
            break
    held: float = min(rho, critical)
    return held


@kernel_part
def _sum(stencil: Stencil, past: FloatArray, place: int, sums: FloatArray) -> None:
    """Sum the values that count for each segment."""
    r, H = stencil.decay, past.shape[1]
    r2 = r * r
    sums[:] = 0.0
    for j in range(past.shape[0]):
        own, now = past[j], past[j, place]
        a, t = 0, place
        # Sums of P over the ages up to a, the latest of the least weight.
        w, u, x, y, n, o = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for q in range(stencil.first[j], stencil.first[j + 1]):
            # sum_{a=1..f} (1 - r^2) r^{f-a} P_{t-a}
            while a < stencil.delay[q]:
                a += 1
                t = t - 1 if t > 0 else H - 1
                w = r * w + (1.0 - r2) * own[t, 0]
                u = r * u + (1.0 - r2) * own[t, 1]
                x = r * x + (1.0 - r2) * own[t, 2]
                y = r * y + (1.0 - r2) * own[t, 3]
                n = r2 * n + (1.0 - r2 * r2) * own[t, 4]
                o = r2 * o + (1.0 - r2 * r2) * own[t, 5]
            # with the factors of P_t, of this sum and of P_{t-f-1}
            old = own[t - 1 if t > 0 else H - 1]
            out, f = sums[stencil.target[q], stencil.wave[q]], stencil.weight[q]
            out[0] += f[0, 0] * now[0] + f[0, 1] * w + f[0, 2] * old[0]
            out[1] += f[0, 0] * now[1] + f[0, 1] * u + f[0, 2] * old[1]
            out[2] += f[0, 0] * now[2] + f[0, 1] * x + f[0, 2] * old[2]
            out[3] += f[0, 0] * now[3] + f[0, 1] * y + f[0, 2] * old[3]
            out[4] += f[1, 0] * now[4] + f[1, 1] * n + f[1, 2] * old[4]
            out[5] += f[1, 0] * now[5] + f[1, 1] * o + f[1, 2] * old[5]


@inline_part
def _evaluate(road: Road, arz: ARZ, stencil: Stencil, state: State, e: int) -> None:
    """Write the estimates of an episode, and their deviations."""
    sums, present, smoothed = state.sums[e], state.present[e], state.smoothed[e]
    for s in range(road.n_segments):
        free, jam, lanes = sums[s, FREE], sums[s, JAM], road.lanes[s]
        # z_c = sum w_j phi_c z_j / sum w_j phi_c
        rho_free, rho_jam = free[VALUE] / free[WEIGHT], jam[VALUE] / jam[WEIGHT]
        v_free, v_jam = free[VALUE + 1] / free[WEIGHT + 1], jam[VALUE + 1] / jam[WEIGHT + 1]
        # m = (1 + tanh((V - v) / dV)) / 2 and z = m z_jam + (1 - m) z_free
        m = stencil.threshold - min(v_free, v_jam)
        m = 0.5 + 0.5 * math.tanh(m / stencil.transition)
        rho = lanes * ((1.0 - m) * rho_free + m * rho_jam)
        gap = lanes * (rho_jam - rho_free)
        present[s, 0] = rho = min(max(rho, 0.0), arz.jam[s])
        present[s, 1] = min(max(m * v_jam + (1.0 - m) * v_free, 0.0), stencil.largest_speed)
        # a_1 n^(1/2) / l^2 + a_2 (rho_jam - rho_free)^2 and b_1 / (1 + n) + b_2 (v_jam - v_free)^2
        length = road.lengths[s]
        vehicles = rho * length
        variation = DENSITY_MODEL[0] * math.sqrt(vehicles) / length**2
        smoothed[s, 0] = variation + DENSITY_MODEL[1] * gap**2
        variation = SPEED_MODEL[0] / (1.0 + vehicles)
        smoothed[s, 1] = variation + SPEED_MODEL[1] * (v_jam - v_free) ** 2
        share = (state.age[e, s] / (state.age[e, s] + STALE)) ** 2
        for i in range(2):
            noise = (1.0 - m) * math.sqrt(max(free[NOISE + i], 0.0)) / free[WEIGHT + i]
            noise += m * math.sqrt(max(jam[NOISE + i], 0.0)) / jam[WEIGHT + i]
            if i == 0:
                noise *= lanes
            unknown = share * STALE_VARIANCE[i] * (lanes**2 if i == 0 else 1.0)
            factor = _factor(state.evidence[e, s, i])
            present[s, 2 + i] = math.sqrt(noise**2 + factor * smoothed[s, i] + unknown)


@kernel_part
def _factor(evidence: FloatArray) -> float:
    """Return the factor k of a segment, at least 1."""
    factor: float = min(max(evidence[0] / evidence[1], 1.0), LARGEST_FACTOR)
    return factor


@kernel
def update(bundle: Bundle, episodes: IntArray, measured: Measurement) -> None:
    """Add what was released of episodes `(k,)` to the sums, and evaluate them."""
    road, arz, channels, stencil, state = bundle.parts
    added = np.empty((road.n_segments, 6))
    for k in range(episodes.size):
        e = episodes[k]
        state.innovations[e] = 0.0
        added[:] = 0.0
        for m in range(channels.first.size):
            if measured.observed[k, m]:
                value = _read_channel(road, channels, stencil, state, e, m, measured, k)
                density, density_noise, speed, speed_noise = value
                share = 1.0 / channels.span[m]
                for s in range(channels.first[m], channels.first[m] + channels.span[m]):
                    _weigh(0, share, density, density_noise, added[s])
                    _weigh(1, share, speed, speed_noise, added[s])
        for s in range(road.n_segments):
            if added[s, WEIGHT] > 0.0:
                _add(stencil, state, e, s, added[s])
        # Estimates are clipped, so that they do not show it.
        state.diverged[e] = not all_finite(state.sums[e].reshape(-1))
        _evaluate(road, arz, stencil, state, e)
        if state.diverged[e]:
            _restart(road, state, e)


@inline_part
def _read_channel(
    road: Road,
    channels: Channels,
    stencil: Stencil,
    state: State,
    e: int,
    m: int,
    measured: Measurement,
    k: int,
) -> tuple[float, float, float, float]:
    """Write a channel's innovations and what they say of the factors; return its value.

    Each of its segments has its average, with a weight and a variance as if they were independent
    values.

    Returns:
        Density of a lane and its variance, speed and its variance.
    """
    values, sigma, centre = measured.values[k, m], measured.sigma[k, m], measured.centre[k]
    first, span = channels.first[m], channels.span[m]
    present, share = state.present[e], 1.0 / span
    lanes, rho, rho_variance, rho_smoothed = 0.0, 0.0, 0.0, 0.0
    y, y_variance, y_smoothed, carried, least = 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(first, first + span):
        density, speed = present[s, 0], present[s, 1]
        lanes += share * road.lanes[s]
        rho += share * density
        rho_variance += (share * present[s, 2]) ** 2
        rho_smoothed += share**2 * state.smoothed[e, s, 0]
        floored = max(density, LEAST_LANE_DENSITY * road.lanes[s])
        by_speed, slip = 1.0, 0.0
        if stencil.flows:
            by_speed, slip = floored, speed - centre[s]
            carried += share * (density * centre[s] + (floored - density) * road.limits[s])
        y += share * (density * slip if stencil.flows else speed)
        y_variance += share**2 * ((by_speed * present[s, 3]) ** 2 + (slip * present[s, 2]) ** 2)
        y_smoothed += share**2 * by_speed**2 * state.smoothed[e, s, 1]
        least += share * floored
    by_flow = 1.0 / least if stencil.flows else 1.0
    for i in range(2):
        error = values[0] - rho if i == 0 else values[1] - y
        noise = sigma[i] ** 2
        variance = noise + (rho_variance if i == 0 else y_variance)
        if not 0.0 < variance < np.inf:
            continue
        state.innovations[e, m, i] = error / math.sqrt(variance)
        smoothed = rho_smoothed if i == 0 else y_smoothed
        for s in range(first, first + span):
            # k = (K + sum M (e^2 - noise) / (noise + M)^2) / (K + sum M^2 / (noise + M)^2)
            evidence = state.evidence[e, s, i]
            known = variance - _factor(evidence) * smoothed
            gain = smoothed / (known + smoothed) ** 2
            evidence[0] += gain * (error**2 - known)
            evidence[1] += gain * smoothed
    return (
        values[0] / lanes,
        (sigma[0] / lanes) ** 2,
        by_flow * (values[1] + carried),
        (by_flow * sigma[1]) ** 2,
    )


@kernel_part
def _add(stencil: Stencil, state: State, e: int, s: int, value: FloatArray) -> None:
    """Add the value of a segment to the sums."""
    now, sums = state.past[e, s, state.place[e]], state.sums[e]
    for c in range(6):
        now[c] += value[c]
    for q in range(stencil.first[s], stencil.first[s + 1]):
        out, f = sums[stencil.target[q], stencil.wave[q]], stencil.weight[q]
        for c in range(NOISE):
            out[c] += f[0, 0] * value[c]
        for c in range(NOISE, 6):
            out[c] += f[1, 0] * value[c]
        state.age[e, stencil.target[q]] = 0.0


class AdaptiveSmoothing(SegmentEstimator):
    """Adaptive smoothing of released values.

    It has no traffic model; the ARZ parameters serve to read densities and speeds off the model's
    inputs. Errors of different segments and of density and speed count as independent.

    Attributes:
        state: Sums and estimates, which predictions and updates change in place.
    """

    restart_kernel = staticmethod(restart)
    predict_kernel = staticmethod(predict)
    update_kernel = staticmethod(update)

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        stencil, n, S = make_stencil(model, settings.asm), n_episodes, model.n_segments
        shape = n, stencil.first.size - 1, int(stencil.delay.max()) + 2, 6
        self.state = State(
            past=np.zeros(shape),
            place=np.zeros(n, dtype=np.int64),
            sums=np.zeros((n, S, 2, 6)),
            present=self.present,
            priors=self.priors,
            smoothed=np.zeros((n, S, 2)),
            age=np.zeros((n, S)),
            evidence=np.zeros((n, S, 2, 2)),
            innovations=self.innovations,
            diverged=self.diverged,
        )
        self.arrays = Bundle(model.road, model.arz, model.channels, stencil, self.state)

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return self.state[: State._fields.index("innovations")]

    @property
    def _limits(self) -> tuple[tuple[AnyArray, float, float], ...]:
        return ((self.state.place, 0, self.state.past.shape[2] - 1),)
