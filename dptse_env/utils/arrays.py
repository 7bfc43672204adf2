"""Type aliases of arrays."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
Observation: TypeAlias = NDArray[np.float32]
Action: TypeAlias = NDArray[Any]
AnyArray: TypeAlias = NDArray[Any]
