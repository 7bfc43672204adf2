"""Checks of declared values: each failure names the path, what is allowed, and the value."""

import math
import os
from collections.abc import Sequence
from numbers import Integral, Real


def require(condition: bool, path: str, allowed: str, value: object) -> None:
    """Raise ``ValueError`` "<path> must be <allowed>, got <value>" unless `condition` holds."""
    if not condition:
        raise ValueError(f"{path} must be {allowed}, got {value!r}")


def integer(path: str, value: object, low: int, high: int | None = None) -> int:
    """Return `value` as an ``int`` within [low, high], both inclusive, or raise ``ValueError``."""
    allowed = f"an integer >= {low}" if high is None else f"an integer in {low}..{high}"
    # A bool is an int to Python.
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ValueError(f"{path} must be {allowed}, got {value!r}")
    number = int(value)
    require(number >= low and (high is None or number <= high), path, allowed, value)
    return number


def finite(path: str, value: object) -> float:
    """Return `value` as a finite ``float``, or raise ``ValueError``."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{path} must be a number, got {value!r}")
    require(math.isfinite(value), path, "finite", value)
    return float(value)


def positive(path: str, value: object) -> float:
    """Return `value` as a finite ``float`` above zero, or raise ``ValueError``."""
    number = finite(path, value)
    require(number > 0.0, path, "> 0", value)
    return number


def non_negative(path: str, value: object) -> float:
    """Return `value` as a finite ``float`` of at least zero, or raise ``ValueError``."""
    number = finite(path, value)
    require(number >= 0.0, path, ">= 0", value)
    return number


def inside(path: str, value: object, low: float, high: float) -> float:
    """Return `value` as a ``float`` strictly between `low` and `high`, or raise ``ValueError``."""
    number = finite(path, value)
    require(low < number < high, path, f"in ({low:g}, {high:g})", value)
    return number


def interval(path: str, value: object, *, allow_zero: bool = False) -> tuple[float, float]:
    """Return `value` as a pair (low, high) with low <= high, both positive unless `allow_zero`."""
    low, high = sequence(path, value, length=2)
    check = non_negative if allow_zero else positive
    pair = check(f"{path}[0]", low), check(f"{path}[1]", high)
    require(pair[0] <= pair[1], path, "a pair (low, high) with low <= high", value)
    return pair


def path_or_none(path: str, value: object) -> str | None:
    """Return a file-system path as a string, or None, or raise ``ValueError``."""
    if value is None:
        return None
    if not isinstance(value, str | os.PathLike):
        raise ValueError(f"{path} must be a path or None, got {value!r}")
    return os.fspath(value)


def sequence(path: str, value: object, length: int | None = None) -> tuple[object, ...]:
    """Return `value` as a tuple, of `length` where given, or raise ``ValueError``."""
    allowed = "a sequence" if length is None else f"a sequence of {length}"
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise ValueError(f"{path} must be {allowed}, got {value!r}")
    require(length is None or len(value) == length, path, allowed, value)
    return tuple(value)
