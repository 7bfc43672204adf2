"""Checks of what release models of other packages release."""

from typing import Any

import numpy as np

from dptse_env.release.base import ReleaseModel, ReleaseRequest
from dptse_env.utils.registry import name_of_class


def check_released(release: ReleaseModel, released: Any, request: ReleaseRequest) -> None:
    """Refuse a release of a wrong shape, or one that is not finite where it was observed."""
    name = name_of_class(release)
    shape = (*request.observed.shape, 2)
    values, sigma = (np.asarray(part) for part in released)
    if values.shape != shape or values.dtype.kind != "f":
        raise ValueError(
            f"privacy.preset {name}.release() must return floats of shape {shape}, got "
            f"{values.dtype} of shape {values.shape}"
        )
    if not np.isfinite(values[request.observed]).all():
        raise ValueError(
            f"privacy.preset {name}.release() must return finite values of observed segments"
        )
    if sigma.shape != (2,) or not (np.isfinite(sigma) & (sigma >= 0.0)).all():
        raise ValueError(
            f"privacy.preset {name}.release() must return two finite standard deviations >= 0, "
            f"got {sigma}"
        )
