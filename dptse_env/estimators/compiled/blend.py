"""The blend of a compiled EKF and a random walk."""

from typing import Any, ClassVar

from dptse_env.estimators.blend import Blend
from dptse_env.estimators.ekf import EKF


class CompiledBlend(Blend):
    """`Blend` with the compiled EKF; blocks of episodes benefit from threads as far as it does."""

    is_compiled: ClassVar[bool] = True
    _filter_type: ClassVar[type[Any]] = EKF
