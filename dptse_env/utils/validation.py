"""Validation of configuration dataclasses: types, ranges, and values from plain JSON.

Keyword values of ``gym.make`` travel as JSON, so every configuration must be reachable from
dictionaries, lists, strings and numbers. The annotation of a field declares its type and range,
``Annotated[float, Interval(0, 1)]``: `checked_fields` enforces it, and the reference of keywords
shows it. An error is one line: ``<path> must be <allowed>, got <value>``.
"""

import dataclasses
import json
import math
import os
import re
import reprlib
import tomllib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")
N = TypeVar("N", int, float)

LARGEST_TOML = 10_000_000
"""Largest size of a TOML file [bytes]."""

LONGEST_SEQUENCE = 100_000
"""Largest number of items in a sequence; checking more would take minutes."""


@dataclass(frozen=True)
class Interval:
    """Range of a number; an end is part of it unless it is open."""

    low: float
    high: float
    open_low: bool = False
    open_high: bool = False

    def __contains__(self, value: float) -> bool:
        """Return whether a number lies in the range; NaN does not."""
        above = value > self.low if self.open_low else value >= self.low
        return above and (value < self.high if self.open_high else value <= self.high)

    def __str__(self) -> str:
        """Return the range in mathematical notation."""
        if self.high == math.inf and self.open_high:
            return f"{'>' if self.open_low else '>='} {self.low:g}"
        left, right = "(" if self.open_low else "[", ")" if self.open_high else "]"
        return f"in {left}{self.low:g}, {self.high:g}{right}"


POSITIVE = Interval(0, math.inf, open_low=True, open_high=True)
"""The finite numbers above zero."""
_FINITE = Interval(-math.inf, math.inf, open_low=True, open_high=True)


def from_mapping(cls: type[T], values: Any, path: str, base: T | None = None) -> T:
    """Build the dataclass ``cls`` from ``values``.

    Args:
        cls: A frozen dataclass. Nested dataclasses, unions of them and tuples are followed.
        values: A mapping of field names; an instance of ``cls`` is returned as it is.
        path: Path of the values, for error messages; empty at the top.
        base: Supplies the fields that ``values`` leaves out.

    Raises:
        ValueError: A key is unknown or missing, or a value has the wrong type or range; the
            message starts with the path of the value.
    """
    if isinstance(values, cls):
        return values
    if not isinstance(values, Mapping):
        raise ValueError(f"{path} must be a mapping or {cls.__name__}, got {shown(values)}")
    prefix = f"{path}." if path else ""
    hints = field_hints(cls)
    for key in values:
        if key not in hints:
            raise ValueError(f"{prefix}{cut(key)} is unknown; allowed: {', '.join(hints)}")
    built = {
        name: convert(hints[name], value, f"{prefix}{name}", getattr(base, name, None))
        for name, value in values.items()
    }
    if base is not None and not built:
        return base
    if base is not None:
        return dataclasses.replace(base, **built)  # type: ignore[type-var]
    missing, checked_type = dataclasses.MISSING, typing.cast(Any, cls)
    for field in dataclasses.fields(checked_type):
        has_default = field.default is not missing or field.default_factory is not missing
        if field.name not in built and not has_default:
            raise ValueError(f"{prefix}{field.name} is missing")
    return cls(**built)


def checked_fields(instance: Any, path: str) -> None:
    """Check the fields of a frozen dataclass against their annotations, in ``__post_init__``.

    Numbers become plain ints and floats and sequences tuples.

    Raises:
        ValueError: A value has the wrong type or range; the message starts with its path.
    """
    prefix = f"{path}." if path else ""
    for name, hint in field_hints(type(instance)).items():
        value = getattr(instance, name)
        converted = convert(hint, value, f"{prefix}{name}", value)
        if converted is not value:
            object.__setattr__(instance, name, converted)


def field_hints(cls: type) -> Mapping[str, Any]:
    """Return the annotations of a dataclass's fields by name, in order."""
    hashable: Any = cls
    return _field_hints(hashable)


@cache
def _field_hints(cls: Any) -> Mapping[str, Any]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls) if field.init}


def convert(hint: Any, value: Any, path: str, base: Any = None) -> Any:
    """Return ``value``, which may be plain JSON or an array, as the annotated type ``hint``.

    A ``base`` of a dataclass has the values of fields that a mapping leaves out.

    Raises:
        ValueError: The value has the wrong type or range; the message starts with ``path``.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    kind, interval, origin, items = _parsed(hint)
    if kind is Any:
        return value
    if kind is int or kind is float:
        return number(kind, value, path, interval)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(items, value, path, base)
    if dataclasses.is_dataclass(kind):
        keep = base if isinstance(base, typing.cast(type, kind)) else None
        return from_mapping(typing.cast(type, kind), value, path, keep)
    if origin is typing.Literal:
        require_name(path, value, items)
        return value
    if origin is tuple:
        return _convert_tuple(items, value, path)
    if (isinstance(value, bool) and kind is not bool) or not isinstance(value, kind):
        name = "None" if kind is type(None) else kind.__name__
        raise ValueError(f"{path} must be of type {name}, got {shown(value)}")
    return value


@cache
def _parsed(hint: Any) -> tuple[Any, Interval | None, Any, tuple[Any, ...]]:
    """Return the type of an annotation, its range, its origin and its arguments."""
    interval = None
    if typing.get_origin(hint) is typing.Annotated:
        hint, *extras = typing.get_args(hint)
        interval = next((extra for extra in extras if isinstance(extra, Interval)), None)
    return hint, interval, typing.get_origin(hint), typing.get_args(hint)


def number(kind: type[N], value: Any, path: str, interval: Interval | None) -> N:
    """Return ``value`` as an int or a float within an interval; a bool is no number here.

    Raises:
        ValueError: It is of another type or out of range; the message starts with ``path``.
    """
    converted: Any = value
    if type(value) is not kind:
        is_number = isinstance(value, Integral if kind is int else Real)
        try:
            converted = kind(value) if is_number and not isinstance(value, bool) else math.nan
        except OverflowError:
            converted = math.nan
    if converted in (_FINITE if interval is None else interval):
        return typing.cast(N, converted)
    raise ValueError(f"{path} must be {allowed_numbers(kind, interval)}, got {shown(value)}")


def allowed_numbers(kind: type, interval: Interval | None) -> str:
    """Describe the allowed numbers in words."""
    if interval is None:
        return "an integer" if kind is int else "a finite number"
    if kind is int and interval.high < math.inf:
        return f"an integer in {interval.low:.0f}..{interval.high:.0f}"
    if kind is int:
        return f"an integer >= {interval.low:.0f}"
    finite = "finite " if interval.high == math.inf and interval.open_high else ""
    return f"a {finite}number {interval}"


def _convert_tuple(items: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        raise ValueError(f"{path} must be a sequence, got {shown(value)}")
    if len(value) > LONGEST_SEQUENCE:
        raise ValueError(f"{path} must have at most {LONGEST_SEQUENCE} items, got {len(value)}")
    if len(items) == 2 and items[1] is Ellipsis:
        items = (items[0],) * len(value)
    if len(items) != len(value):
        raise ValueError(f"{path} must have {len(items)} items, got {len(value)}: {shown(value)}")
    return tuple(
        convert(item, element, f"{path}[{i}]")
        for i, (item, element) in enumerate(zip(items, value, strict=True))
    )


def _convert_union(options: tuple[Any, ...], value: Any, path: str, base: Any) -> Any:
    """Convert to the option that fits; among dataclasses, to the one that has all the keys."""
    if isinstance(value, Mapping):
        classes: list[Any] = [option for option in options if dataclasses.is_dataclass(option)]
        fits = [cls for cls in classes if set(value) <= set(field_hints(cls))]
        if classes:
            return convert((fits or classes)[0], value, path, base)
    if value is not None and types.NoneType in options:
        options = tuple(option for option in options if option is not types.NoneType)
        suffix = " or None"
    else:
        suffix = ""
    if not isinstance(value, Mapping):
        # A sequence and a single value are two ways to say the same: only one of them is meant.
        is_sequence = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        fits = [option for option in options if (_parsed(option)[2] is tuple) == is_sequence]
        options = tuple(fits) if fits and len(fits) < len(options) else options
    if len(options) == 1:
        try:
            return convert(options[0], value, path, base)
        except ValueError as problem:
            head = f"{path} must be "
            if not str(problem).startswith(head):  # concerns an item of the value
                raise
            raise ValueError(str(problem).replace(", got ", f"{suffix}, got ", 1)) from None
    if all(dataclasses.is_dataclass(option) for option in options):
        names = " or ".join(option.__name__ for option in options)
        if not isinstance(value, options):
            raise ValueError(f"{path} must be a mapping or {names}{suffix}, got {shown(value)}")
    problems = []
    for option in options:
        try:
            return convert(option, value, path, base)
        except ValueError as problem:
            problems.append(str(problem))
    raise ValueError("; or ".join(problems))


LONGEST_SHOWN = 200
"""Characters of a value that a message shows."""


class _Short(reprlib.Repr):
    def repr_int(self, x: int, level: int) -> str:
        """Describe an integer of more digits than Python puts in words, by their number."""
        digits = int(x.bit_length() * math.log10(2))
        return f"an integer of {digits} digits" if digits > LONGEST_SHOWN else repr(x)


_SHORT = _Short()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 5, LONGEST_SHOWN, LONGEST_SHOWN
_SHORT.maxdict = _SHORT.maxlist = _SHORT.maxtuple = 50


def shown(value: Any) -> str:
    """Return a value for a message: in one line, cut where it is long or nested deeply."""
    return cut(re.sub(r"\s*\n\s*", " ", _SHORT.repr(value)))


def cut(value: Any) -> str:
    """Return a key, a name or a reason for a message: without quotes, escaped and cut."""
    text = str(value) if isinstance(value, str | Exception) else shown(value)
    text = text if text.isprintable() else repr(text)[1:-1]
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


_NON_NEGATIVE = Interval(0, math.inf, open_high=True)


@contextmanager
def within(place: str) -> Iterator[None]:
    """Put a place, such as ``"road.toml: "``, in front of messages on bad values in the body.

    Raises:
        ValueError: As the body; unchanged where the place is empty.
    """
    try:
        yield
    except ValueError as problem:
        if not place:
            raise
        raise ValueError(f"{place}{problem}") from problem


def require(condition: bool, path: str, allowed: str, value: object) -> None:
    """Raise ``ValueError`` "<path> must be <allowed>, got <value>" unless `condition` holds."""
    if not condition:
        raise ValueError(f"{path} must be {allowed}, got {shown(value)}")


def require_name(path: str, name: object, known: Iterable[str]) -> None:
    """Raise ``ValueError`` unless `name` is one of the `known` strings."""
    names = list(known)
    if not isinstance(name, str) or name not in names:
        raise ValueError(f"{path} must be one of {', '.join(names)}, got {shown(name)}")


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


def parse_json(text: str | bytes, path: str) -> Any:
    """Parse JSON.

    Raises:
        ValueError: It is no JSON; the message starts with ``path``.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise ValueError(f"{path} must be JSON: {cut(problem)}") from problem


def read_json(path: str | Path) -> Any:
    """Parse a JSON file.

    Raises:
        ValueError: It cannot be read or is no JSON; the message starts with its path.
    """
    try:
        text = Path(path).read_bytes()
    except OSError as problem:
        raise ValueError(f"{path} cannot be read: {problem.strerror}") from problem
    return parse_json(text, str(path))


def read_toml(path: str | os.PathLike[str], kind: str) -> dict[str, Any]:
    """Parse a TOML file.

    Args:
        path: The file.
        kind: What it is, for messages, such as "road file".

    Raises:
        ValueError: It cannot be read, is too large, or is no TOML; the message starts with its
            path.
    """
    path = Path(path)
    try:
        size, content = path.stat().st_size, b""
        if size <= LARGEST_TOML:
            content = path.read_bytes()
    except OSError as problem:
        raise ValueError(f"{path}: the {kind} cannot be read: {problem.strerror}") from problem
    require(size <= LARGEST_TOML, f"{path}: a {kind}", f"of at most {LARGEST_TOML} bytes", size)
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    # Integers of thousands of digits are a ValueError, and no TOMLDecodeError.
    except (ValueError, RecursionError) as problem:
        raise ValueError(f"{path}: a {kind} must be TOML: {cut(problem)}") from problem


def check_object(content: Any, path: str, keys: Mapping[str, type]) -> dict[str, Any]:
    """Return parsed JSON where it is an object that has exactly the given keys.

    Raises:
        ValueError: It is no object, or has other keys or types; the message starts with ``path``.
    """
    if not isinstance(content, dict) or set(content) != set(keys):
        got = shown(sorted(content) if isinstance(content, dict) else content)
        raise ValueError(f"{path} must be a mapping with the keys {', '.join(keys)}, got {got}")
    for key, kind in keys.items():
        if not isinstance(content[key], kind) or isinstance(content[key], bool):
            got = shown(content[key])
            raise ValueError(f"{path}: {key} must be of type {kind.__name__}, got {got}")
    return content
