"""Floors: errors of estimates that are made from the true traffic, which nobody has."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agents.evaluation.episodes import WARM_UP, run_episodes
from agents.experiments.runner import make_batch
from agents.studies.estimators.plan import EstimatorDesign
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Records
from dptse_env.utils.arrays import FloatArray

SMOOTHED = 11
"""Seconds of the moving average of the second floor, centred."""


class Floor(NamedTuple):
    """An estimate from the true traffic and its error x 1000."""

    label: str
    error: float


def floors(design: EstimatorDesign, world: str, records: Records) -> list[Floor]:
    """Return the error of the truth a second ago, and of its moving average."""
    cell, seeds = design.cell(world, "random_walk"), design.traffic_seeds[:16]
    env = make_batch(cell.place.env, design.keywords(cell), seeds, records)
    process, kept = env.process, []

    def on_second() -> None:
        if process.time[0] > 0:
            truth = process.truth(np.arange(process.n_episodes))
            kept.append(truth[:, : process.interface.n_mainline].copy())

    run_episodes(
        env, make_schedule(design.schedule, env), traffic_seeds=seeds, seeds=seeds,
        on_second=on_second,
    )  # fmt: skip
    truth = np.stack(kept)
    corridor = process.config.corridor
    scales = np.array([corridor.density_scale, corridor.speed_scale])
    known = _filled(truth)
    windows = np.lib.stride_tricks.sliding_window_view(known, SMOOTHED, axis=0)
    half = SMOOTHED // 2
    here = truth[WARM_UP : len(truth) - half]
    smoothed = windows.mean(axis=-1)[WARM_UP - half :]
    late = _error(known[WARM_UP - 1 : -1], truth[WARM_UP:], scales)
    return [
        Floor("the truth of a second ago", late),
        Floor(f"the truth smoothed over {SMOOTHED} s", _error(smoothed, here, scales)),
    ]


def _filled(truth: FloatArray) -> FloatArray:
    """Return the truth with the last known speed where a segment is empty, shape (T, n, N, 2)."""
    filled = truth.copy()
    for t in range(1, len(filled)):
        empty = truth[t, ..., 0] <= 0.0
        filled[t, ..., 1] = np.where(empty, filled[t - 1, ..., 1], filled[t, ..., 1])
    return filled


def _error(estimated: FloatArray, truth: FloatArray, scales: FloatArray) -> float:
    """Return the environment's error x 1000, mean over seconds and episodes."""
    squares = ((estimated - truth) / scales) ** 2
    occupied = truth[..., 0] > 0.0
    total = squares[..., 0].sum(-1) + (squares[..., 1] * occupied).sum(-1)
    counts = truth.shape[-2] + occupied.sum(-1)
    return float(1000.0 * np.sqrt(total / counts).mean())
