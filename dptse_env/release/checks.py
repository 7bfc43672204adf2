"""Checks of what release models of other packages release."""

from typing import Any

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.release.base import ReleaseModel, ReleaseRequest
from dptse_env.utils.registry import name_of_class


def check_released(release: ReleaseModel, released: Any, request: ReleaseRequest) -> None:
    """Refuse a release of a wrong type or shape, or that is not finite where it was observed."""
    path = f"privacy.preset {name_of_class(release)}.release()"
    if not isinstance(released, Measurement):
        raise ValueError(f"{path} must return a Measurement, got {type(released).__name__}")
    columns, places = request.observed.shape, (len(request.observed), release.setup.n_places)
    for name, array, kind, shape in (
        ("observed", released.observed, "b", columns),
        ("values", released.values, "f", (*columns, 2)),
        ("sigma", released.sigma, "f", (*columns, 2)),
        ("centre", released.centre, "f", places),
    ):
        found = np.asarray(array)
        if found.shape != shape or found.dtype.kind != kind:
            raise ValueError(
                f"{path} must return {name} of shape {shape}, got {found.dtype} of shape "
                f"{found.shape}"
            )
    if (released.observed & ~request.observed).any():
        raise ValueError(f"{path} must not say that a column was observed that was not asked for")
    if not np.isfinite(released.values[released.observed]).all():
        raise ValueError(f"{path} must return finite values of observed segments")
    if not (np.isfinite(released.sigma) & (released.sigma >= 0.0)).all():
        raise ValueError(f"{path} must return finite standard deviations >= 0")
    if release.releases_flow and not np.isfinite(released.centre).all():
        raise ValueError(f"{path} must return finite centres of flows")
