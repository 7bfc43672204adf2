"""Checks of single arguments: each failure names the path, what is allowed, and the value."""

import math
from collections.abc import Iterable

from dptse_env.utils.fields import POSITIVE, Interval, number

_NON_NEGATIVE = Interval(0, math.inf, open_high=True)


def require(condition: bool, path: str, allowed: str, value: object) -> None:
    """Raise ``ValueError`` "<path> must be <allowed>, got <value>" unless `condition` holds."""
    if not condition:
        raise ValueError(f"{path} must be {allowed}, got {value!r}")


def require_name(path: str, name: object, known: Iterable[str]) -> None:
    """Raise ``ValueError`` unless `name` is one of the `known` strings."""
    names = list(known)
    if not isinstance(name, str) or name not in names:
        raise ValueError(f"{path} must be one of {', '.join(names)}, got {name!r}")


def integer(path: str, value: object, low: int, high: float = math.inf) -> int:
    """Return `value` as an ``int`` within [low, high], both inclusive, or raise ``ValueError``."""
    return number(int, value, path, Interval(low, high))


def positive(path: str, value: object) -> float:
    """Return `value` as a finite ``float`` above zero, or raise ``ValueError``."""
    return number(float, value, path, POSITIVE)


def non_negative(path: str, value: object) -> float:
    """Return `value` as a finite ``float`` of at least zero, or raise ``ValueError``."""
    return number(float, value, path, _NON_NEGATIVE)


def inside(path: str, value: object, low: float, high: float) -> float:
    """Return `value` as a ``float`` strictly between `low` and `high`, or raise ``ValueError``."""
    return number(float, value, path, Interval(low, high, open_low=True, open_high=True))
