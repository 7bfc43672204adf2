"""Replay of a measured field of density and speed as the truth, for estimators alone.

A field has no vehicles. What a release would say is the field itself plus the noise of a release
model whose deviation needs the road alone, as ``corrected``; the segments at both ends are the
boundary.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dptse_env.config import EnvConfig
from dptse_env.estimators import Measurement, make_estimator
from dptse_env.evaluation import WARM_UP
from dptse_env.importers.fields import FieldRoad, FieldSource, by_second
from dptse_env.parts import make_model, make_release
from dptse_env.traffic import Corridor, Demand
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.validation import require


class Field(NamedTuple):
    """Density [veh/km] and speed [km/h] of T seconds of N + 2 segments, from upstream on."""

    density: FloatArray  # (T, N + 2)
    speed: FloatArray  # (T, N + 2)
    segment_length: float  # [km]


class FieldScore(NamedTuple):
    """Errors of an estimator over all windows of a field, from second 61 on.

    Attributes:
        error: Mean error of a second as an environment scores it, x 1000.
        density: Density RMSE [veh/km].
        speed: Speed RMSE [km/h].
        chi2_density: Mean square of density errors over their reported deviations.
        chi2_speed: The same for speeds.
    """

    error: float
    density: float
    speed: float
    chi2_density: float
    chi2_speed: float


def read_field(source: FieldSource, segments: int, lanes: int, speed_limit: float) -> Field:
    """Read a field, averaged over `segments` + 2 segments and interpolated to seconds.

    Raises:
        ValueError: A file is malformed or of another unit, or there are fewer cells than segments.
        OSError: A file cannot be read.
    """
    density, flow = source.read(lanes, speed_limit)
    each = source.cells_of(segments, len(density))
    return Field(*by_second(density, flow, segments + 2, source.interval), each * source.cell)


def field_corridor(field: Field, lanes: int, speed_limit: float) -> Corridor:
    """Return a straight road for a field; scales grow with lanes and limit as on other roads."""
    road = FieldRoad("measured-field", field.density.shape[1] - 2, lanes, speed_limit)
    entering = float((field.density * field.speed)[:, 0].mean())
    return road.corridor(field.segment_length, len(field.density)).replaced(
        demand=Demand(mainline=((0.0, entering),)),
        average_dwell=3600.0 * field.segment_length / float(field.speed[:, 1:-1].mean()),
    )


@dataclass(frozen=True)
class Replay:
    """A field that estimators are given noisy queries of, by round robin.

    The truth is cut into windows, and each is replayed with several draws of the noise. Every
    window begins with an estimate of 25 veh/km a lane at half the speed limit.

    Attributes:
        field: The field.
        config: Road, noise, bandwidth, estimator and its settings.
        window: Seconds of a window.
        n_repeats: Draws of the noise.
    """

    field: Field
    config: EnvConfig
    window: int = 450
    n_repeats: int = 8

    @cached_property
    def sigma(self) -> FloatArray:
        """Deviations of the noise of densities [veh/km] and speeds [km/h].

        Raises:
            ValueError: The release model needs vehicles, or not all of them are connected.
        """
        preset = self.config.privacy.preset
        release = make_release(self.config)
        blind = "one that needs no vehicles, as 'corrected'"
        require(not release.needs_vehicles, "privacy.preset", blind, preset)
        whole = "1, and detectors left out"
        share = self.config.penetration.share
        require(not self.config.has_separate_sensors, "penetration.share", whole, share)
        return release.sigma

    def run(self) -> FieldScore:
        """Return the errors of the estimator; the noise is the same for all.

        Raises:
            ValueError: The estimator refuses the road, or see `sigma`.
        """
        field, config, rng = self.field, self.config, np.random.default_rng(0)
        corridor, bandwidth, sigma = config.corridor, config.bandwidth, self.sigma
        starts = np.arange(0, len(field.density) - self.window, self.window)
        starts = np.repeat(starts, self.n_repeats)
        times = starts[:, None] + np.arange(self.window + 1)
        truth = np.stack([field.density, field.speed], axis=-1)[times]
        k, n, everyone = len(starts), corridor.geometry.n_mainline, np.arange(len(starts))
        model = make_model(config)
        made = make_estimator(config.estimator, config.backend, model, k, config.settings())
        lanes, limits = (
            np.array(of) for of in (corridor.geometry.segment_lanes, corridor.geometry.speed_limits)
        )
        start = np.tile(25.0 * lanes, (k, 1)), np.tile(0.5 * limits, (k, 1))
        made.reset(everyone, model.states(*start), rng.spawn(k))
        squares, ratios = [], []
        for t in range(1, self.window + 1):
            ends = truth[:, t - 1, [0, -1]]
            made.predict(everyone, model.boundary_inputs(ends[..., 0], ends[..., 1]))
            observed = np.zeros((k, n), dtype=bool)
            observed[:, (t * bandwidth + np.arange(bandwidth)) % n] = True
            now = truth[:, t, 1:-1]
            values = now + sigma * rng.normal(size=now.shape)
            made.update(everyone, Measurement.of(model, observed, values, sigma))
            if t > WARM_UP:
                said = made.estimate()
                error = np.stack([said.density, said.speed], -1) - now
                squares.append(error**2)
                ratios.append((error / np.stack([said.density_std, said.speed_std], -1)) ** 2)
        squared, chi2 = np.array(squares), np.mean(ratios, axis=(0, 1, 2))
        scales = np.array([corridor.scales.density_scale, corridor.scales.speed_scale])
        error = np.sqrt((squared / scales**2).mean(axis=(-2, -1))).mean()
        density, speed = np.sqrt(squared.mean(axis=(0, 1, 2)))
        return FieldScore(1000.0 * float(error), *map(float, (density, speed, *chi2)))
