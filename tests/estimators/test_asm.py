"""Adaptive smoothing beside its equations, and what it gives."""

import numpy as np
import pytest

from dptse_env.estimators import AdaptiveSmoothingSettings, EstimatorSettings
from dptse_env.estimators.asm import (
    CONFIDENCE,
    DENSITY_MODEL,
    FACTOR_MEMORY,
    LARGEST_FACTOR,
    LEAST_LANE_DENSITY,
    REACH,
    SPEED_MODEL,
    STALE,
    STALE_VARIANCE,
    TRUSTED,
)
from dptse_env.traffic import PAPER_HIGHWAY
from tests.helpers import UNEVEN

from .helpers import run, simulate, started, step

ASM = AdaptiveSmoothingSettings(
    time=6.0, length=0.15, free_wave=90.0, jam_wave=15.0, threshold=55.0, boundary_weight=0.7
)


class Textbook:
    """One episode, by sums over all values, as the module's docstring has them.

    A value is (chain, place [km], step, weight without noise, what it is of each quantity, the
    variances of its noise times the weight). Quantities are densities per lane and speeds.
    """

    def __init__(self, model, start, settings):
        self.model, self.settings, self.t = model, settings.asm, 0
        road = model.road
        self.chain, self.x = np.zeros((2, model.n_segments))
        for i in range(1 + road.stretch.max()):
            chain = np.flatnonzero(road.stretch == i)
            lengths = road.lengths[chain]
            self.chain[chain], self.x[chain] = i, np.cumsum(lengths) - lengths / 2
        traffic = np.stack([model.density(start[None])[0], model.speed(start[None])[0]], -1)
        self.now = np.concatenate([traffic, np.zeros_like(traffic)], axis=1)
        unit = np.array([model.density_scale, model.speed_scale])
        variance = settings.initial_variance * unit**2
        self.values = [
            (self.chain[s], self.x[s], 0, 1.0, traffic[s] / [lanes, 1], variance / [lanes**2, 1])
            for s, lanes in enumerate(road.lanes[: model.n_segments])
        ]
        self.evidence = np.full((model.n_segments, 2, 2), CONFIDENCE)
        self.smoothed = np.zeros((model.n_segments, 2))
        self.last = np.zeros(model.n_segments)

    def factors(self):
        ratio = self.evidence[..., 0] / self.evidence[..., 1]
        return np.clip(ratio, 1.0, LARGEST_FACTOR)

    def evaluate(self):
        model, constants = self.model, self.settings
        lanes, lengths = model.road.lanes, model.road.lengths
        chain, x, t, weight = (np.array([v[i] for v in self.values]) for i in range(4))
        z, noise = (np.array([v[i] for v in self.values]) for i in (4, 5))
        trust = np.array(TRUSTED) / (np.array(TRUSTED) + noise / weight[:, None])
        trusted = weight[:, None] * trust
        for s in range(model.n_segments):
            means, deviations = [], []
            gap = x - self.x[s]
            near = (chain == self.chain[s]) & (np.abs(gap) <= REACH * constants.length)
            for c in (constants.free_wave, -constants.jam_wave):
                late = (t - self.t) * model.time_step - 3600.0 * gap / c
                phi = np.exp(-np.abs(gap) / constants.length - np.abs(late) / constants.time)
                phi = np.where(near, phi, 0.0)
                total = phi @ trusted
                means.append(phi @ (trusted * z) / total)
                deviations.append(np.sqrt(phi**2 @ (trust**2 * noise)) / total)
            free, jam = means
            m = constants.threshold - min(free[1], jam[1])
            m = 0.5 * (1.0 + np.tanh(m / constants.transition))
            density, speed = m * jam + (1.0 - m) * free
            carried = m * deviations[1] + (1.0 - m) * deviations[0]
            between = (jam - free) * [lanes[s], 1.0]
            density = np.clip(lanes[s] * density, 0.0, model.jam_density[s])
            n = density * lengths[s]
            self.smoothed[s] = (
                DENSITY_MODEL[0] * np.sqrt(n) / lengths[s] ** 2
                + DENSITY_MODEL[1] * between[0] ** 2,
                SPEED_MODEL[0] / (1.0 + n) + SPEED_MODEL[1] * between[1] ** 2,
            )
            variances = (carried * [lanes[s], 1.0]) ** 2 + self.factors()[s] * self.smoothed[s]
            age = (self.t - self.last[s]) * model.time_step
            variances += (age / (age + STALE)) ** 2 * np.array(STALE_VARIANCE) * [lanes[s] ** 2, 1]
            speed = np.clip(speed, 0.0, model.largest_speed)
            self.now[s] = density, speed, *np.sqrt(variances)

    def predict(self, inputs):
        model, road, weight = self.model, self.model.road, self.settings.boundary_weight
        self.t += 1
        v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
        ends = []
        for s, column, cell in zip(road.entries, road.entry_inputs, road.entry_cells, strict=True):
            jam, lanes = model.arz.jam[cell], road.lanes[cell]
            demand, w = inputs[column : column + 2]
            rho = np.linspace(0.0, jam * (w / v_f / (1.0 + gamma)) ** (1.0 / gamma), 100_001)
            rho = np.interp(demand, rho * (w - v_f * (rho / jam) ** gamma), rho)
            v = w - v_f * (rho / jam) ** gamma
            ends.append((s, self.x[s] - road.lengths[s], rho / lanes, v))
        for s, column, cell in zip(road.exits, road.exit_inputs, road.exit_cells, strict=True):
            jam, lanes = model.arz.jam[cell], road.lanes[cell]
            rho, (own, speed) = inputs[column], self.now[s, :2]
            w = speed + v_f * (own / model.jam_density[s]) ** gamma
            v = max(w - v_f * (rho / jam) ** gamma, 0.0)
            ends.append((s, self.x[s] + road.lengths[s], rho / lanes, v))
        for s, x, rho, v in ends:
            self.values.append((self.chain[s], x, self.t, weight, np.array([rho, v]), np.zeros(2)))
        self.evidence = CONFIDENCE + np.exp(-model.time_step / FACTOR_MEMORY) * (
            self.evidence - CONFIDENCE
        )
        self.evaluate()

    def update(self, observed, values, sigma, centre):
        """Return innovations."""
        model, innovations = self.model, np.zeros(values.shape)
        S = model.n_segments
        lanes, flows = model.road.lanes[:S], model.centre is not None
        density, speed, density_std, speed_std = self.now.T
        floored = np.maximum(density, LEAST_LANE_DENSITY * lanes)
        evidence = self.evidence.copy()
        for m in np.flatnonzero(observed):
            H = model.averaging[m]
            covered = np.flatnonzero(H)
            slip = speed - centre if flows else np.zeros(len(speed))
            by_speed = floored if flows else np.ones(len(speed))
            y = H @ (density * slip) if flows else H @ speed
            v = values[m, 1]
            if flows:
                added = (floored - density) * model.road.limits[:S]
                v = (v + H @ (density * centre + added)) / (H @ floored)
            z = np.array([values[m, 0] / (H @ lanes), v])
            noise = np.array([sigma[m, 0] / (H @ lanes), sigma[m, 1] / (H @ by_speed)]) ** 2
            errors = values[m] - [H @ density, y]
            variances = sigma[m] ** 2 + [
                H**2 @ density_std**2,
                H**2 @ ((by_speed * speed_std) ** 2 + (slip * density_std) ** 2),
            ]
            innovations[m] = errors / np.sqrt(variances)
            smoothed = [
                H**2 @ self.smoothed[:, 0], H**2 @ (by_speed**2 * self.smoothed[:, 1])
            ]  # fmt: skip
            for s in covered:
                # As many values as segments, of the row's variance times their number.
                variance = noise * len(covered) * H[s] ** 2
                self.values.append((self.chain[s], self.x[s], self.t, H[s], z, variance))
                gap = np.abs(self.x - self.x[s])
                reached = (self.chain == self.chain[s]) & (gap <= REACH * self.settings.length)
                self.last[reached] = self.t
                for i in range(2):
                    ratio = evidence[s, i, 0] / evidence[s, i, 1]
                    rest = variances[i] - np.clip(ratio, 1.0, LARGEST_FACTOR) * smoothed[i]
                    gain = smoothed[i] / (rest + smoothed[i]) ** 2
                    evidence[s, i] += gain * np.array([errors[i] ** 2 - rest, smoothed[i]])
        self.evidence = evidence
        self.evaluate()
        return innovations


@pytest.mark.parametrize(
    ("release", "road"), [("speed", PAPER_HIGHWAY), ("flow", PAPER_HIGHWAY), ("rows", UNEVEN)]
)
def test_it_is_the_sum_over_all_values_that_its_equations_say(release, road):
    settings = EstimatorSettings(asm=ASM)
    episodes = simulate("published", n_steps=60, noise=1.5, release=release, road=road)
    model, close = episodes.model, {"rtol": 1e-9, "atol": 1e-9}
    smoother = started("asm", "compiled", episodes, settings)
    textbook = Textbook(model, episodes.start[0], settings)
    centre = np.full((60, 1, model.n_segments), np.nan)
    if model.centre is not None:
        centre[:] = model.centre if episodes.centre is None else episodes.centre
    for k in range(60):
        step(smoother, episodes, k)
        textbook.predict(episodes.inputs[k, 0])
        given = (array[k, 0] for array in (episodes.observed, episodes.values, episodes.sigma))
        found = textbook.update(*given, centre[k, 0])
        shown = np.stack(smoother.estimate(), axis=-1)[0]
        np.testing.assert_allclose(shown, textbook.now, **close)
        np.testing.assert_allclose(smoother.innovations[0], found, **close)


def test_a_mean_stays_when_nothing_follows_for_long():
    """Weights fall by exp(-10) each second, to less than the smallest number."""
    episodes = simulate("published", n_steps=200)
    settings = EstimatorSettings(asm=AdaptiveSmoothingSettings(time=0.1, boundary_weight=0.0))
    smoother = started("asm", "compiled", episodes, settings)
    run(smoother, episodes, range(12))
    nothing = np.zeros((1, 19), bool)
    run(smoother, episodes, range(12, 150), observed=nothing)
    before = smoother.estimate()
    run(smoother, episodes, range(150, 200), observed=nothing)
    assert not smoother.diverged.any()
    after = smoother.estimate()
    np.testing.assert_allclose(after.density, before.density, rtol=1e-9)
    np.testing.assert_allclose(after.speed, before.speed, rtol=1e-9)
