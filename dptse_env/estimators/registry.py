"""Estimators by name and backend."""

from __future__ import annotations

from typing import get_args

from dptse_env.estimators.base import Backend, Estimator, EstimatorSettings
from dptse_env.estimators.open_loop import OpenLoop
from dptse_env.estimators.random_walk import RandomWalk
from dptse_env.model import ARZModel

ESTIMATORS = ("ekf", "random_walk", "open_loop")
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
        name: `ekf`, `random_walk` (no traffic model) or `open_loop` (no measurements).
        backend: `compiled` (numba) or `reference` (numpy and filterpy); the random walk is
            plain numpy under both.
        model: The traffic model.
        n_episodes: Episodes to follow, >= 1.
        settings: Tuning; defaults if left out.

    Raises:
        ValueError: for an unknown name or backend, or no episodes; says what is allowed.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {name!r}")
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be >= 1, got {n_episodes}")
    settings = settings or EstimatorSettings()
    if name == "random_walk":
        return RandomWalk(model, n_episodes, settings)
    # Each backend brings its own library, which the other must not need.
    if backend == "reference":
        return _reference(name, model, n_episodes, settings)
    return _compiled(name, model, n_episodes, settings)


def _reference(
    name: str, model: ARZModel, n_episodes: int, settings: EstimatorSettings
) -> Estimator:
    plain = ARZModel(model.network, model.parameters, model.time_step)
    if name == "open_loop":
        return OpenLoop(plain, n_episodes, settings)
    from dptse_env.estimators.reference.ekf import ReferenceEKF  # noqa: PLC0415

    return ReferenceEKF(plain, n_episodes, settings)


def _compiled(
    name: str, model: ARZModel, n_episodes: int, settings: EstimatorSettings
) -> Estimator:
    if name == "open_loop":
        from dptse_env.model.compiled import CompiledARZModel  # noqa: PLC0415

        fast = CompiledARZModel(model.network, model.parameters, model.time_step)
        return OpenLoop(fast, n_episodes, settings)
    from dptse_env.estimators.compiled.ekf import CompiledEKF  # noqa: PLC0415

    return CompiledEKF(model, n_episodes, settings)
