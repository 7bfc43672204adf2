"""Traffic state estimators with a common protocol, by name and backend."""

from pkgutil import resolve_name
from typing import Any, get_args

import numpy as np

from dptse_env.estimators.base import Backend, BatchEstimator, Estimate, Estimator, Measurement
from dptse_env.estimators.settings import (
    AdaptiveSmoothingSettings,
    BlendSettings,
    DemandSettings,
    EnsembleSettings,
    EstimatorSettings,
    HorizonSettings,
    MixtureSettings,
    RecurrentSettings,
    SigmaPointSettings,
    load_settings,
)
from dptse_env.model import ARZModel
from dptse_env.utils.fields import shown
from dptse_env.utils.registry import Registry, is_foreign, missing_methods, name_of_class

__all__ = [
    "BACKENDS",
    "ESTIMATORS",
    "REFERENCES",
    "AdaptiveSmoothingSettings",
    "BatchEstimator",
    "BlendSettings",
    "DemandSettings",
    "EnsembleSettings",
    "Estimate",
    "Estimator",
    "EstimatorSettings",
    "HorizonSettings",
    "Measurement",
    "MixtureSettings",
    "RecurrentSettings",
    "SigmaPointSettings",
    "check_estimate",
    "check_estimator",
    "check_settings",
    "checked_settings",
    "make_estimator",
    "require_time_step",
    "settings_type",
]


def _expected(part: Any) -> str | None:
    if isinstance(part, type):
        return missing_methods(part, ("reset", "predict", "update", "estimate"))
    return None if callable(part) else "be a class, or callable with (model, n_episodes, settings)"


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
        "mixture": "dptse_env.estimators.mixture:Mixture",
    },
    check=_expected,
)
"""Estimators by name, classes or functions of (model, n_episodes, settings), imported when they are
asked for. Their attribute ``settings_type`` may be a dataclass of other settings; a class without
demand states has ``has_demand`` False, one that does not step the model ``steps_model`` False."""
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
    has_demand = getattr(ESTIMATORS.find(estimator), "has_demand", True)
    if not has_demand and settings.demand is not None:
        raise ValueError(
            f"estimator_settings.demand must be None for {estimator!r}, which has no demand states"
        )


def check_settings(estimator: Any, model: ARZModel, settings: Any) -> None:
    """Refuse settings that an estimator cannot have on a road; it is not made.

    A class may have a static method ``check_settings(model, settings)``, which raises
    ``ValueError``. The model has the demand states that the settings ask for.

    Raises:
        ValueError: A setting is out of range on this road, the estimator has no demand states, or
            it steps the model and its time step violates the CFL condition.
    """
    check_demand(estimator, settings)
    require_time_step(estimator, model)
    check = getattr(ESTIMATORS.find(estimator), "check_settings", None)
    if check is not None:
        check(with_demand(model, settings), settings)


def require_time_step(estimator: Any, model: ARZModel) -> None:
    """Refuse a road whose segments are too short for an estimator that steps the model.

    Raises:
        ValueError: The model's time step violates the CFL condition.
    """
    if not _steps_model(ESTIMATORS.find(estimator)):
        return
    try:
        model.require_time_step()
    except ValueError as problem:
        free = ", ".join(name for name in ESTIMATORS if not _steps_model(ESTIMATORS.find(name)))
        raise ValueError(
            f"{problem}; or choose other parameters, or an estimator that does not step the "
            f"model: {free}"
        ) from problem


def _steps_model(part: Any) -> bool:
    return bool(getattr(part, "steps_model", True))


def with_demand(model: ARZModel, settings: Any) -> ARZModel:
    """Return a model that has demand states where the settings ask for them, and only there."""
    has_demand = getattr(settings, "demand", None) is not None
    if has_demand == (model.n_demand_states > 0):
        return model
    return ARZModel(
        model.road, model.parameters, model.time_step, model.reference_speed, model.channels,
        has_demand,
    )  # fmt: skip


def make_estimator(
    estimator: Any, backend: str, model: ARZModel, n_episodes: int, settings: Any = None
) -> Estimator:
    """Build an estimator for a batch of episodes.

    Args:
        estimator: `ekf`, `ukf`, `enkf`, `mhe`, `random_walk` (no traffic model), `blend` (a mean
            of EKF and random walk), `open_loop` (no measurements), `recurrent` (a network), `asm`
            (adaptive smoothing), `mixture` (of others), a registered name,
            ``"package.module:Class"`` or a class.
        backend: `compiled` (numba), or `reference` (filterpy, qpsolvers, numpy), which EKF, UKF,
            EnKF and MHE have.
        model: The traffic model.
        n_episodes: Number of episodes, >= 1.
        settings: Settings; None for the defaults.

    Raises:
        MissingExtraError: The backend is `reference` and its libraries are not installed.
        ValueError: Name or backend is unknown, the estimator does not have the backend, there are
            no episodes, a setting is out of range on this road, or the estimator lacks a method or
            an attribute.
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be >= 1, got {n_episodes}")
    check_estimator(estimator, backend)
    settings = settings_type(estimator)() if settings is None else settings
    check_settings(estimator, model, settings)
    reference = backend == "reference"
    part: Any = resolve_name(REFERENCES[estimator]) if reference else ESTIMATORS.find(estimator)
    made: Estimator = part(with_demand(model, settings), n_episodes, settings)
    if is_foreign(made):
        _check_attributes(made, model, n_episodes)
    return made


def settings_type(estimator: Any) -> type:
    """Return the dataclass of an estimator's settings."""
    cls: type = getattr(ESTIMATORS.find(estimator), "settings_type", EstimatorSettings)
    return cls


def checked_settings(estimator: Any, settings: Any) -> Any:
    """Return an estimator's settings, by name, as they are, or the defaults in place of None.

    Raises:
        ValueError: There are none of this name, they are of another type, or the estimator has no
            demand states, which they ask for.
    """
    expected = settings_type(estimator)
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


def check_estimate(estimator: Estimator, estimate: Estimate, n_segments: int) -> None:
    """Refuse an estimate that is not finite or not of shape (n, S).

    Estimators of this package are reset when they diverge; those of other packages may not be.
    """
    shape = estimator.n_episodes, n_segments
    for name in ("density", "speed", "density_std", "speed_std"):
        values = np.asarray(getattr(estimate, name, None))
        got = f"{values.dtype} of shape {values.shape}"
        if values.shape == shape and values.dtype.kind == "f":
            if np.isfinite(values).all():
                continue
            episode, segment = np.argwhere(~np.isfinite(values))[0].tolist()
            got = f"{values[episode, segment]} in episode {episode}, segment {segment}"
        raise ValueError(
            f"estimator {name_of_class(estimator)}.estimate() must return finite floats "
            f"{name!r} of shape {shape}, got {got}"
        )


def _check_attributes(estimator: Estimator, model: ARZModel, n_episodes: int) -> None:
    """Refuse an estimator whose methods, arrays or attributes do not follow the protocol."""
    name = name_of_class(estimator)
    missing = missing_methods(estimator, ("reset", "predict", "update", "estimate"))
    if missing is not None:
        raise ValueError(f"estimator {name} must {missing}")
    shapes = {
        "innovations": (n_episodes, model.channels.size, 2),
        "diverged": (n_episodes,),
        "fallback": (n_episodes,),
    }
    for attribute, shape in shapes.items():
        found = getattr(estimator, attribute, None)
        if not isinstance(found, np.ndarray) or found.shape != shape:
            got = "none" if found is None else f"shape {np.shape(found)}"
            raise ValueError(
                f"estimator {name} must have an array {attribute!r} of shape {shape}, got {got}"
            )
    found = getattr(estimator, "n_episodes", None)
    if found != n_episodes:
        message = f"estimator {name} must have 'n_episodes' equal to {n_episodes}, got {found!r}"
        raise ValueError(message)
    if getattr(estimator, "is_compiled", None) is None:
        raise ValueError(f"estimator {name} must have 'is_compiled', got None")
    check_estimate(estimator, estimator.estimate(), model.n_segments)
