"""Traffic state estimators, by name and backend."""

from pkgutil import resolve_name
from typing import Any, get_args

from dptse_env.estimators.base import (
    Backend,
    Estimate,
    Estimator,
    KernelEstimator,
    Measurement,
    Played,
)
from dptse_env.estimators.settings import (
    AdaptiveSmoothingSettings,
    BlendSettings,
    DemandSettings,
    EnsembleSettings,
    EstimatorSettings,
    HorizonSettings,
    RecurrentSettings,
    SigmaPointSettings,
)
from dptse_env.estimators.tuned import load_settings
from dptse_env.model import ARZModel
from dptse_env.utils.registry import Registry
from dptse_env.utils.validation import shown

__all__ = [
    "BACKENDS",
    "ESTIMATORS",
    "REFERENCES",
    "AdaptiveSmoothingSettings",
    "BlendSettings",
    "DemandSettings",
    "EnsembleSettings",
    "Estimate",
    "Estimator",
    "EstimatorSettings",
    "HorizonSettings",
    "KernelEstimator",
    "Measurement",
    "Played",
    "RecurrentSettings",
    "SigmaPointSettings",
    "check_estimator",
    "check_settings",
    "checked_settings",
    "make_estimator",
    "require_time_step",
]


def _expected(part: Any) -> str | None:
    if not (isinstance(part, type) and issubclass(part, Estimator)):
        return "be a subclass of dptse_env.estimators.Estimator"
    lacking = ", ".join(f"{name}()" for name in sorted(part.__abstractmethods__))
    return f"have {lacking}" if lacking else None


ESTIMATORS = Registry(
    "estimator",
    {
        "ekf": "dptse_env.estimators.ekf:EKF",
        "ukf": "dptse_env.estimators.ukf:UKF",
        "enkf": "dptse_env.estimators.enkf:EnKF",
        "mhe": "dptse_env.estimators.mhe:MHE",
        "random_walk": "dptse_env.estimators.simple:RandomWalk",
        "blend": "dptse_env.estimators.simple:Blend",
        "open_loop": "dptse_env.estimators.simple:OpenLoop",
        "recurrent": "dptse_env.estimators.recurrent:Recurrent",
        "asm": "dptse_env.estimators.asm:AdaptiveSmoothing",
    },
    check=_expected,
)
"""Estimators by name, imported when they are asked for."""
REFERENCES = {
    "ekf": "dptse_env.estimators.reference:ReferenceEKF",
    "ukf": "dptse_env.estimators.reference:ReferenceUKF",
    "enkf": "dptse_env.estimators.reference:ReferenceEnKF",
    "mhe": "dptse_env.estimators.reference:ReferenceMHE",
}
"""The backend ``reference`` of the estimators that have one."""
BACKENDS = get_args(Backend)


def check_demand(estimator: Any, settings: Any) -> None:
    """Check that an estimator has the demand states that its settings ask for.

    Raises:
        ValueError: It has none.
    """
    has_demand = ESTIMATORS.find(estimator).has_demand
    if not has_demand and settings.demand is not None:
        raise ValueError(
            f"estimator_settings.demand must be None for {estimator!r}, which has no demand states"
        )


def check_settings(estimator: Any, model: ARZModel, settings: Any) -> None:
    """Refuse settings that an estimator cannot have on a road; it is not made.

    Raises:
        ValueError: A setting is out of range on this road, the estimator has no demand states, or
            it steps the model and its time step violates the CFL condition.
    """
    check_demand(estimator, settings)
    require_time_step(estimator, model)
    ESTIMATORS.find(estimator).check_settings(with_demand(model, settings), settings)


def require_time_step(estimator: Any, model: ARZModel) -> None:
    """Refuse a road whose segments are too short for an estimator that steps the model.

    Raises:
        ValueError: The model's time step violates the CFL condition.
    """
    if not ESTIMATORS.find(estimator).steps_model:
        return
    try:
        model.require_time_step()
    except ValueError as problem:
        free = ", ".join(name for name in ESTIMATORS if not ESTIMATORS.find(name).steps_model)
        raise ValueError(
            f"{problem}; or choose other parameters, or an estimator that does not step the "
            f"model: {free}"
        ) from problem


def with_demand(model: ARZModel, settings: Any) -> ARZModel:
    """Return a model that has demand states where the settings ask for them, and only there."""
    demand = getattr(settings, "demand", None)
    memory = None if demand is None else demand.memory
    if memory == model.demand_memory:
        return model
    return ARZModel(
        model.road, model.parameters, model.time_step, model.centre, model.channels, memory
    )


def make_estimator(
    estimator: Any, backend: str, model: ARZModel, n_episodes: int, settings: Any = None
) -> Estimator:
    """Build an estimator for a batch of episodes.

    Args:
        estimator: `ekf`, `ukf`, `enkf`, `mhe`, `random_walk` (no traffic model), `blend` (a mean
            of EKF and random walk), `open_loop` (no measurements), `recurrent` (a neural network),
            `asm` (adaptive smoothing), a registered name,
            ``"package.module:Class"`` or a class.
        backend: `compiled` (numba), or `reference` (filterpy, qpsolvers, numpy), which EKF, UKF,
            EnKF and MHE have.
        model: The traffic model.
        n_episodes: Number of episodes, >= 1.
        settings: Settings; None for the defaults.

    Raises:
        MissingExtraError: The backend is `reference` and its libraries are not installed.
        ValueError: Name or backend is unknown, the estimator does not have the backend, there are
            no episodes, a setting is out of range on this road, or the estimator lacks a method.
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be >= 1, got {n_episodes}")
    check_estimator(estimator, backend)
    settings = ESTIMATORS.find(estimator).settings_type() if settings is None else settings
    check_settings(estimator, model, settings)
    reference = backend == "reference"
    part: Any = resolve_name(REFERENCES[estimator]) if reference else ESTIMATORS.find(estimator)
    made: Estimator = part(with_demand(model, settings), n_episodes, settings)
    return made


def checked_settings(estimator: Any, settings: Any) -> Any:
    """Return an estimator's settings, by name, as they are, or the defaults in place of None.

    Raises:
        ValueError: There are none of this name, they are of another type, or the estimator has no
            demand states, which they ask for.
    """
    expected = ESTIMATORS.find(estimator).settings_type
    if isinstance(settings, str):
        settings = load_settings(settings)
    elif settings is None:
        settings = expected()
    elif not isinstance(settings, expected):
        raise ValueError(
            f"estimator_settings must be a mapping, the name of a set, or a {expected.__name__}, "
            f"got {shown(settings)}"
        )
    check_demand(estimator, settings)
    return settings


def check_estimator(estimator: Any, backend: str) -> None:
    """Refuse an unknown estimator or backend, or a backend that an estimator does not have."""
    ESTIMATORS.find(estimator)
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {shown(backend)}")
    if backend == "reference" and not (isinstance(estimator, str) and estimator in REFERENCES):
        raise ValueError(
            f"backend must be 'compiled' for {ESTIMATORS.name_of(estimator)!r}, only "
            f"{', '.join(REFERENCES)} have a reference; got 'reference'"
        )
