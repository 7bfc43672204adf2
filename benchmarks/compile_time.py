"""What numba's compiler costs: a first step without its cache, and one with it."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

_FIRST_STEP = """
import time
import numpy as np
from dptse_env.estimators import make_estimator
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY

model = ARZModel(PAPER_HIGHWAY, load_parameters("w99-3lane"))
start = time.perf_counter()
own = make_estimator({name!r}, "compiled", model, 1)
one, s = np.arange(1), model.n_segments
density, speed = 20.0 * np.ones((1, s)), 90.0 * np.ones((1, s))
own.reset(one, model.states(density, speed), [np.random.default_rng(0)])
cells = np.full((1, model.n_boundaries), 20.0)
own.predict(one, model.boundary_inputs(cells, 4.0 * cells))
own.update(one, np.ones((1, s), bool), np.stack([density, speed], -1), np.array([15.0, 6.0]))
own.estimate()
print(time.perf_counter() - start)
"""


def first_step(estimator: str, cache: str) -> float:
    """Return the time [s] of making an estimator and its first step, in a process of its own.

    Args:
        estimator: Its name.
        cache: Folder of numba's cache.
    """
    done = subprocess.run(
        [sys.executable, "-c", _FIRST_STEP.format(name=estimator)],
        env={**os.environ, "NUMBA_CACHE_DIR": cache},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    return float(done.stdout)


def cold_and_warm(estimator: str) -> tuple[float, float]:
    """Return the time [s] of the first step with an empty cache, then of one more process."""
    with tempfile.TemporaryDirectory() as cache:
        return first_step(estimator, cache), first_step(estimator, cache)
