"""Checks of numbers that come from a user, with errors that name where the number stands."""

import math
from numbers import Real

__all__ = ["finite_positive", "inside", "positive_count"]


def finite_positive(path: str, value: object) -> float:
    """Return `value` as a float if it is a finite number above zero.

    Raises:
        ValueError: if it is not; the message names `path`, what is allowed and the value.
    """
    number = _number(path, value)
    if not number > 0.0:
        raise ValueError(f"{path} must be > 0, got {value!r}")
    if math.isinf(number):
        raise ValueError(f"{path} must be finite, got {value!r}")
    return number


def inside(path: str, value: object, low: float, high: float) -> float:
    """Return `value` as a float if it lies strictly between `low` and `high`.

    Raises:
        ValueError: if it does not; the message names `path`, what is allowed and the value.
    """
    number = _number(path, value)
    if not low < number < high:
        raise ValueError(f"{path} must be in ({low:g}, {high:g}), got {value!r}")
    return number


def positive_count(path: str, value: object) -> int:
    """Return `value` as an int if it is a whole number of at least one.

    Raises:
        ValueError: if it is not; the message names `path`, what is allowed and the value.
    """
    number = _number(path, value)
    if not (number >= 1.0 and number.is_integer()):
        raise ValueError(f"{path} must be a whole number >= 1, got {value!r}")
    return int(number)


def _number(path: str, value: object) -> float:
    """Refuse what only looks like a number: a bool is an int to Python, a string is not."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{path} must be a number, got {value!r}")
    return float(value)
