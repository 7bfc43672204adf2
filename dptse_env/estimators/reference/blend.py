"""The blend of filterpy's EKF and a random walk, a reference for the compiled one."""

from typing import Any, ClassVar

from dptse_env.estimators.blend import Blend
from dptse_env.estimators.reference.ekf import ReferenceEKF


class ReferenceBlend(Blend):
    """`Blend` with the reference EKF."""

    _filter_type: ClassVar[type[Any]] = ReferenceEKF
