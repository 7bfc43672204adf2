"""Arrays that kernels take as one argument."""

from typing import Any

from numba import types
from numba.experimental import structref

from dptse_env.utils.kernels import kernel


@structref.register
class _BundleType(types.StructRef):
    """numba's type of a bundle."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Keep one version for constants and variables of a type."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Bundle(structref.StructRefProxy):
    """Named tuples of arrays and numbers as one argument of kernels.

    To pass a filter's forty arrays one by one takes 4 us, a third of its step at one episode, and a
    bundle of them less than one. Its arrays are those that it was made of, not copies.

    Attributes:
        parts: The named tuples.
    """

    parts: Any

    def __new__(cls, *parts: Any) -> "Bundle":
        """Make a bundle of named tuples."""
        bundle: Bundle = _bundled(parts)
        bundle.parts = parts
        return bundle

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy, or pickle, the arrays."""
        return Bundle, self.parts


structref.define_proxy(Bundle, _BundleType, ["parts"])


@kernel
def _bundled(parts: Any) -> Any:
    return Bundle(parts)
