"""Time of an EKF step: compiled, alone and in batches, beside filterpy, all in one run.

    OMP_NUM_THREADS=1 python benchmarks/bench_estimators.py

A step is `predict` plus `update` of one episode with 14 measured segments, 28 outputs, on the
paper's highway. filterpy runs twice: alone, with its matrices given, and as the reference
estimator, which also evaluates the numpy model and its Jacobian.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from dptse_env.estimators import EstimatorSettings, make_estimator
from dptse_env.estimators.base import Estimator
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY

SIGMA = np.array([15.0, 6.0])
STEPS = 200


def main() -> None:
    arguments = parse()
    model = ARZModel(PAPER_HIGHWAY, load_parameters(arguments.parameters))
    rows = [
        ("filterpy alone", 1, bare_filterpy(model, arguments.segments)),
        ("reference (filterpy)", 1, episode("reference", model, 1, arguments.segments)),
        *(
            (f"compiled, batch of {n}", n, episode("compiled", model, n, arguments.segments))
            for n in (1, 64, 1024)
        ),
    ]
    times = interleaved([run for _, _, run in rows], arguments.seconds)
    alone = times[0] / STEPS
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    print(f"{2 * arguments.segments} outputs, OMP_NUM_THREADS {threads}, best of several runs")
    print(f"{'':24}{'us per step':>12}{'filterpy alone / it':>21}")
    for (name, n, _), seconds in zip(rows, times, strict=True):
        each = seconds / STEPS / n
        print(f"{name:24}{1e6 * each:12.1f}{alone / each:20.1f}x")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parameters", default="w99-3lane", help="ARZ parameter set")
    parser.add_argument("--segments", type=int, default=14, help="measured segments a step")
    parser.add_argument("--seconds", type=float, default=10.0, help="time to spend, about")
    return parser.parse_args()


def episode(backend: str, model: ARZModel, n: int, n_measured: int) -> Callable[[], None]:
    """A run of STEPS steps over n episodes with traffic that moves and other sets every step."""
    rng = np.random.default_rng(0)
    estimator: Estimator = make_estimator("ekf", backend, model, n, EstimatorSettings())
    everyone, streams = np.arange(n), [np.random.default_rng(i) for i in range(n)]
    start = model.states(
        np.full((n, model.n_segments), 0.1) * model.jam_density,
        np.full((n, model.n_segments), 0.6 * model.speed_scale),
    )
    density = np.full((n, model.n_boundaries), 8.0) * (1.0 + rng.random((n, model.n_boundaries)))
    inputs = model.boundary_inputs(density, np.full(density.shape, 0.7 * model.speed_scale))
    observed = rng.random((STEPS, n, model.n_segments)).argsort(axis=-1) < n_measured
    noise = SIGMA * rng.normal(size=(8, n, model.n_segments, 2))
    values = model.measure(start) + noise

    def run() -> None:
        estimator.reset(everyone, start, streams)
        for k in range(STEPS):
            estimator.predict(everyone, inputs)
            estimator.update(everyone, observed[k], values[k % 8], SIGMA)

    return run


def bare_filterpy(model: ARZModel, n_measured: int) -> Callable[[], None]:
    """A run of STEPS steps of filterpy's filter with F, H and the measurement function given."""
    rng = np.random.default_rng(0)
    size, outputs = model.n_states, 2 * n_measured
    jacobian, noise = rng.normal(size=(outputs, size)), np.eye(outputs)
    measured = rng.normal(size=(STEPS, outputs))
    plain = ExtendedKalmanFilter(dim_x=size, dim_z=outputs)
    plain.F = np.eye(size) + 0.01 * rng.normal(size=(size, size)) / size
    plain.x = np.zeros(size)

    def run() -> None:
        plain.P = np.eye(size)
        for k in range(STEPS):
            plain.predict()
            plain.update(measured[k], lambda _: jacobian, lambda x: jacobian @ x, R=noise)

    return run


def interleaved(runs: list[Callable[[], None]], seconds: float) -> list[float]:
    """Shortest time of each run [s], taken in turns so that all meet the same weather."""
    for run in runs:  # compiles, warms caches
        run()
    shortest = [float("inf")] * len(runs)
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        for i, run in enumerate(runs):
            start = time.perf_counter()
            run()
            shortest[i] = min(shortest[i], time.perf_counter() - start)
    return shortest


if __name__ == "__main__":
    main()
