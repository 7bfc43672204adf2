"""Checks of what release models of other packages release."""

from typing import Any

import numpy as np

from dptse_env.release.base import ReleaseModel, ReleaseRequest
from dptse_env.utils.registry import name_of_class


def check_released(release: ReleaseModel, released: Any, request: ReleaseRequest) -> None:
    """Refuse a release of a wrong shape, or one that is not finite where it was observed."""
    name = name_of_class(release)
    shape = (*request.observed.shape, 2)
    values, sigma = np.asarray(released.values), np.asarray(released.sigma)
    if values.shape != shape or values.dtype.kind != "f":
        raise ValueError(
            f"privacy.preset {name}.release() must return floats of shape {shape}, got "
            f"{values.dtype} of shape {values.shape}"
        )
    if not np.isfinite(values[request.observed]).all():
        raise ValueError(
            f"privacy.preset {name}.release() must return finite values of observed segments"
        )
    if sigma.shape not in ((2,), shape) or not (np.isfinite(sigma) & (sigma >= 0.0)).all():
        raise ValueError(
            f"privacy.preset {name}.release() must return finite standard deviations >= 0, two or "
            f"of shape {shape}, got {sigma if sigma.size == 2 else sigma.shape}"
        )
    if released.centre is not None:
        centre, n_segments = np.asarray(released.centre), release.setup.corridor.n_segments
        finite = centre.dtype.kind == "f" and np.isfinite(centre).all()
        if (
            centre.ndim != 2
            or len(centre) != shape[0]
            or centre.shape[1] < n_segments
            or not finite
        ):
            raise ValueError(
                f"privacy.preset {name}.release() must return finite centres of shape "
                f"{(shape[0], n_segments)} or more, got shape {centre.shape}"
            )
