"""Estimators by name and backend."""

from __future__ import annotations

import importlib
from typing import get_args

from dptse_env.estimators.base import Backend, Estimator
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel

# Each backend brings its own library, which the other must not need: modules load when asked for.
_MODELS = {
    "compiled": "dptse_env.model.compiled:CompiledARZModel",
    "reference": "dptse_env.model.arz:ARZModel",
}
_CLASSES = {
    "ekf": {
        "compiled": "dptse_env.estimators.compiled.ekf:CompiledEKF",
        "reference": "dptse_env.estimators.reference.ekf:ReferenceEKF",
    },
    "ukf": {
        "compiled": "dptse_env.estimators.compiled.ukf:CompiledUKF",
        "reference": "dptse_env.estimators.reference.ukf:ReferenceUKF",
    },
    "enkf": {
        "compiled": "dptse_env.estimators.compiled.enkf:CompiledEnKF",
        "reference": "dptse_env.estimators.reference.enkf:ReferenceEnKF",
    },
    "mhe": {
        "compiled": "dptse_env.estimators.compiled.mhe:CompiledMHE",
        "reference": "dptse_env.estimators.reference.mhe:ReferenceMHE",
    },
    "random_walk": dict.fromkeys(_MODELS, "dptse_env.estimators.random_walk:RandomWalk"),
    "open_loop": dict.fromkeys(_MODELS, "dptse_env.estimators.open_loop:OpenLoop"),
}

ESTIMATORS = tuple(_CLASSES)
BACKENDS = get_args(Backend)


def make_estimator(
    name: str,
    backend: str,
    model: ARZModel,
    n_episodes: int,
    settings: EstimatorSettings | None = None,
) -> Estimator:
    """Build an estimator for a batch of episodes.

    Args:
        name: `ekf`, `ukf`, `enkf`, `mhe`, `random_walk` (no traffic model) or `open_loop` (no
            measurements).
        backend: `compiled` (numba) or `reference` (numpy, filterpy, qpsolvers); the random walk
            is plain numpy under both.
        model: The traffic model.
        n_episodes: Episodes to follow, >= 1.
        settings: Tuning; defaults if left out.

    Raises:
        ValueError: for an unknown name or backend, or no episodes; says what is allowed.
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be >= 1, got {n_episodes}")
    check_estimator(name, backend)
    own = _load(_MODELS[backend])(
        model.network, model.parameters, model.time_step, model.reference_speed
    )
    estimator: Estimator = _load(_CLASSES[name][backend])(
        own, n_episodes, settings or EstimatorSettings()
    )
    return estimator


def check_estimator(name: str, backend: str) -> None:
    """Check that there is such an estimator, without loading it.

    Raises:
        ValueError: for an unknown name or backend.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {name!r}")
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")


def _load(path: str) -> type:
    module, _, name = path.partition(":")
    loaded: type = getattr(importlib.import_module(module), name)
    return loaded
