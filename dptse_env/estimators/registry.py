"""Estimators by name and backend."""

from pkgutil import resolve_name
from typing import Any, NamedTuple, get_args

import numpy as np

from dptse_env.estimators.base import Backend, Estimate, Estimator
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.registry import Registry, is_foreign, missing_methods, name_of_class


class Backends(NamedTuple):
    """The classes of an estimator that ships with the package, as ``"module:Class"``.

    Modules are imported on demand, since the backends need different libraries.
    """

    compiled: str
    reference: str


def _filter(name: str, cls: str) -> Backends:
    package = "dptse_env.estimators"
    return Backends(
        f"{package}.compiled.{name}:Compiled{cls}", f"{package}.reference.{name}:Reference{cls}"
    )


def _expected(part: Any) -> str | None:
    if isinstance(part, type):
        return missing_methods(part, ("reset", "predict", "update", "estimate"))
    return None if callable(part) else "be a class, or callable with (model, n_episodes, settings)"


_WALK = "dptse_env.estimators.random_walk:RandomWalk"
_OPEN = "dptse_env.estimators.open_loop:OpenLoop"
_LEARNED = "dptse_env.estimators.learned.recurrent"
_RECURRENT = Backends(f"{_LEARNED}:CompiledRecurrent", f"{_LEARNED}:ReferenceRecurrent")
_WITHOUT_DEMAND = (Backends(_WALK, _WALK), Backends(_OPEN, _OPEN), _RECURRENT)
ESTIMATORS = Registry(
    "estimator",
    {
        "ekf": Backends(
            "dptse_env.estimators.ekf:EKF", "dptse_env.estimators.reference.ekf:ReferenceEKF"
        ),
        "ukf": Backends(
            "dptse_env.estimators.ukf:UKF", "dptse_env.estimators.reference.ukf:ReferenceUKF"
        ),
        "enkf": Backends(
            "dptse_env.estimators.enkf:EnKF", "dptse_env.estimators.reference.enkf:ReferenceEnKF"
        ),
        "mhe": Backends(
            "dptse_env.estimators.mhe:MHE", "dptse_env.estimators.reference.mhe:ReferenceMHE"
        ),
        "random_walk": Backends(_WALK, _WALK),
        "blend": _filter("blend", "Blend"),
        "open_loop": Backends(_OPEN, _OPEN),
        "recurrent": _RECURRENT,
    },
    check=_expected,
)
"""Estimators by name. Those of other packages are classes or functions of (model, n_episodes,
settings); their attribute ``settings_type`` may be a dataclass of other settings."""
BACKENDS = get_args(Backend)


def check_demand(estimator: Any, settings: Any) -> None:
    """Check that an estimator has the demand states that its settings ask for.

    Raises:
        ValueError: It has no traffic model.
    """
    if getattr(settings, "demand", None) is None:
        return
    if ESTIMATORS.find(estimator) in _WITHOUT_DEMAND:
        raise ValueError(
            f"estimator_settings.demand must be None for {estimator!r}, which has no traffic model"
        )


def make_estimator(
    estimator: Any, backend: str, model: ARZModel, n_episodes: int, settings: Any = None
) -> Estimator:
    """Build an estimator for a batch of episodes.

    Args:
        estimator: `ekf`, `ukf`, `enkf`, `mhe`, `random_walk` (no traffic model), `blend` (a mean
            of EKF and random walk), `open_loop` (no measurements), `recurrent` (a network), a
            registered name, ``"package.module:Class"`` or a class.
        backend: `compiled` (numba) or `reference` (numpy, filterpy, qpsolvers); the random walk
            is plain numpy under both.
        model: The traffic model.
        n_episodes: Number of episodes, >= 1.
        settings: Settings; None for the defaults.

    Raises:
        ValueError: Name or backend is unknown, there are no episodes, or the estimator lacks a
            method or an attribute.
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be >= 1, got {n_episodes}")
    check_estimator(estimator, backend)
    part = ESTIMATORS.find(estimator)
    settings = settings_type(estimator)() if settings is None else settings
    check_demand(estimator, settings)
    has_demand = getattr(settings, "demand", None) is not None
    if has_demand != (model.n_demand_states > 0):
        model = ARZModel(
            model.network, model.parameters, model.time_step, model.reference_speed, model.rows,
            has_demand,
        )  # fmt: skip
    factory = resolve_name(getattr(part, backend)) if isinstance(part, Backends) else part
    made: Estimator = factory(model, n_episodes, settings)
    if is_foreign(made):
        _check_attributes(made, model, n_episodes)
    return made


def settings_type(estimator: Any) -> type:
    """Return the dataclass of an estimator's settings."""
    cls: type = getattr(ESTIMATORS.find(estimator), "settings_type", EstimatorSettings)
    return cls


def check_estimator(estimator: Any, backend: str) -> None:
    """Refuse an unknown estimator or backend; no estimator of this package is imported."""
    ESTIMATORS.find(estimator)
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")


def check_estimate(estimator: Estimator, estimate: Estimate, n_segments: int) -> None:
    """Refuse an estimate that is not finite or not of shape (n, S).

    Estimators of this package are reset when they diverge; those of other packages may not be.
    """
    shape = estimator.n_episodes, n_segments
    for name in ("density", "speed", "density_std", "speed_std"):
        values = np.asarray(getattr(estimate, name, None))
        if values.shape != shape or values.dtype.kind != "f" or not np.isfinite(values).all():
            raise ValueError(
                f"estimator {name_of_class(estimator)}.estimate() must return finite floats "
                f"{name!r} of shape {shape}, got {values.dtype} of shape {values.shape}"
            )


def _check_attributes(estimator: Estimator, model: ARZModel, n_episodes: int) -> None:
    """Refuse an estimator whose methods, arrays or attributes do not follow the protocol."""
    name = name_of_class(estimator)
    missing = missing_methods(estimator, ("reset", "predict", "update", "estimate"))
    if missing is not None:
        raise ValueError(f"estimator {name} must {missing}")
    shapes = {
        "innovations": (n_episodes, model.rows.n_rows, 2),
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
