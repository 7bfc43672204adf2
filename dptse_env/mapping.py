"""Frozen dataclasses from plain mappings, with errors that name the path.

Keyword values of ``gym.make`` travel as JSON, so every configuration must be reachable from
dictionaries, lists, strings and numbers.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


def from_mapping(cls: type[T], values: Any, path: str, base: T | None = None) -> T:
    """Build the dataclass ``cls`` from ``values``.

    Args:
        cls: A frozen dataclass. Nested dataclasses, unions of them and tuples are followed.
        values: A mapping of field names; an instance of ``cls`` is returned as it is.
        path: Where the values stand, for error messages; empty at the top.
        base: Supplies the fields that ``values`` leaves out.

    Raises:
        ValueError: A key is unknown or missing, or a value has the wrong type or range; the
            message starts with the path of the value.
    """
    if isinstance(values, cls):
        return values
    if not isinstance(values, Mapping):
        raise ValueError(f"{path} must be a mapping or a {cls.__name__}, got {values!r}")
    prefix = f"{path}." if path else ""
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in values:
        if key not in fields:
            raise ValueError(f"{prefix}{key} is unknown; allowed: {', '.join(fields)}")
    hints = typing.get_type_hints(cls)
    built = {
        name: _convert(hints[name], value, f"{prefix}{name}", getattr(base, name, None))
        for name, value in values.items()
    }
    if base is not None:
        return dataclasses.replace(base, **built)  # type: ignore[type-var]
    for name, field in fields.items():
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if required and name not in built:
            raise ValueError(f"{prefix}{name} is missing")
    return cls(**built)


def _convert(hint: Any, value: Any, path: str, base: Any) -> Any:
    """Return ``value`` as the annotated type ``hint``, or raise with its path."""
    if isinstance(value, np.generic):
        value = value.item()
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(typing.get_args(hint), value, path, base)
    if dataclasses.is_dataclass(hint):
        keep = base if isinstance(base, typing.cast(type, hint)) else None
        return from_mapping(typing.cast(type, hint), value, path, keep)
    if origin is typing.Literal:
        if value not in typing.get_args(hint):
            allowed = ", ".join(map(repr, typing.get_args(hint)))
            raise ValueError(f"{path} must be one of {allowed}, got {value!r}")
        return value
    if origin is tuple:
        return _convert_tuple(typing.get_args(hint), value, path)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    wrong_bool = isinstance(value, bool) and hint is not bool
    if hint is not Any and (wrong_bool or not isinstance(value, hint)):
        name = "None" if hint is type(None) else hint.__name__
        raise ValueError(f"{path} must be of type {name}, got {value!r}")
    return value


def _convert_tuple(items: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence | range):
        raise ValueError(f"{path} must be a sequence, got {value!r}")
    if len(items) == 2 and items[1] is Ellipsis:
        items = (items[0],) * len(value)
    if len(items) != len(value):
        raise ValueError(f"{path} must have {len(items)} items, got {len(value)}: {value!r}")
    return tuple(
        _convert(item, one, f"{path}[{i}]", None)
        for i, (item, one) in enumerate(zip(items, value, strict=True))
    )


def _convert_union(options: tuple[Any, ...], value: Any, path: str, base: Any) -> Any:
    """Take the option that fits; among dataclasses, the one that knows all the keys."""
    if isinstance(value, Mapping):
        classes = [option for option in options if dataclasses.is_dataclass(option)]
        fits = [
            option
            for option in classes
            if set(value) <= {field.name for field in dataclasses.fields(option)}
        ]
        if classes:
            return _convert((fits or classes)[0], value, path, base)
    problems = []
    for option in options:
        try:
            return _convert(option, value, path, base)
        except ValueError as problem:
            problems.append(str(problem))
    raise ValueError("; or ".join(problems))
