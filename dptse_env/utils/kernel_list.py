"""The functions that an estimator's first step compiles, with the types of their arguments.

``kernel_list.json`` is written by ``tests/kernel_list.py``. It holds a list by estimator, in the
order in which another process compiles them, and the fields of the named tuples among the types.
An entry that fits no more costs time only: what is missing is compiled at its first call.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from dptse_env.utils.registry import name_of_class

PATH = Path(__file__).with_name("kernel_list.json")


class Listed(NamedTuple):
    """A function, as ``"module:name"``, and numba's types of its arguments."""

    function: str
    signature: tuple[Any, ...]


@cache
def listed(estimator: str) -> tuple[Listed, ...]:
    """Return the list of an estimator; it is empty where there is none."""
    return read(PATH.read_text(encoding="utf-8"), estimator)


def read(text: str, estimator: str) -> tuple[Listed, ...]:
    """Return the list of an estimator from what `written` returned."""
    kept = json.loads(text)
    return tuple(
        Listed(function, tuple(_read(spelled, kept["tuples"]) for spelled in arguments))
        for function, *arguments in kept["estimators"].get(estimator, ())
    )


def written(lists: dict[str, list[Listed]]) -> str:
    """Return lists by estimator as the text of `PATH`, a line each entry."""
    tuples: dict[str, list[Any]] = {}
    estimators = {
        estimator: [
            [entry.function, *(_spelled(kind, tuples) for kind in entry.signature)]
            for entry in entries
        ]
        for estimator, entries in lists.items()
    }
    parts = (_lines(tuples), ",\n".join(f'"{e}": {_lines(k)}' for e, k in estimators.items()))
    return '{{"tuples": {}, "estimators": {{\n{}\n}}}}\n'.format(*parts)


def _spelled(kind: Any, tuples: dict[str, list[Any]]) -> Any:
    """Return a type as JSON: a list is a tuple, a name with a colon a named tuple."""
    from numba import types  # noqa: PLC0415  (only compiled estimators import numba)

    if isinstance(kind, types.BaseNamedTuple):
        name = name_of_class(kind.instance_class)
        fields = [_spelled(field, tuples) for field in kind]
        if tuples.setdefault(name, fields) != fields:
            raise ValueError(f"the fields of {name} have other types in one function than another")
        return name
    if isinstance(kind, types.BaseTuple):
        return [_spelled(field, tuples) for field in kind]
    if isinstance(kind, types.Array) and kind.layout == "C" and kind.aligned:
        access = "" if kind.mutable else " readonly"
        return f"{kind.dtype} {kind.ndim}d{access}"
    if kind in types.number_domain or kind == types.boolean:
        return str(kind)
    raise ValueError(f"no spelling of the type {kind}")


def _read(spelled: Any, tuples: dict[str, list[Any]]) -> Any:
    from numba import types  # noqa: PLC0415  (only compiled estimators import numba)

    if isinstance(spelled, list):
        return types.BaseTuple.from_types([_read(field, tuples) for field in spelled])
    if ":" in spelled:
        fields = [_read(field, tuples) for field in tuples[spelled]]
        return types.BaseTuple.from_types(fields, resolve_name(spelled))
    name, *array = spelled.split()
    scalar = types.boolean if name == "bool" else getattr(types, name)
    if not array:
        return scalar
    return types.Array(scalar, int(array[0].removesuffix("d")), "C", readonly="readonly" in array)


def _lines(entries: Any) -> str:
    """Return an object or list as JSON with a line for each member."""
    if isinstance(entries, dict):
        rows = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in entries.items()]
        return "{{\n{}\n}}".format(",\n".join(rows))
    return "[\n{}\n]".format(",\n".join(json.dumps(entry) for entry in entries))
