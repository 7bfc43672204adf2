"""Markdown of the reference that the code declares: keywords and commands."""

import dataclasses
import json
import types
import typing
from importlib import import_module
from typing import Any

import griffe

from dptse_env.traffic.corridor import PARTS, Corridor
from dptse_env.utils.validation import Interval, allowed_numbers
from scripts.dptse import GROUPS, MODULES


def keyword_table(path: str) -> str:
    """Return a table of the fields that the docstring of a configuration class describes.

    Args:
        path: Import path of the class.
    """
    module, _, name = path.rpartition(".")
    lines = ["| keyword | values | default | meaning |", "| :-- | :-- | :-- | :-- |"]
    lines += _rows(getattr(import_module(module), name))
    return "\n".join(['<div class="keywords" markdown>', "", *lines, "", "</div>"])


def _rows(cls: Any) -> list[str]:
    """Return a line for each field; parts of a corridor have those of their own fields."""
    hints = typing.get_type_hints(cls, include_extras=True)
    meanings = {
        each.name: " ".join(each.description.split())
        for section in griffe.Docstring(cls.__doc__).parse("google")
        if section.kind is griffe.DocstringSectionKind.attributes
        for each in section.value
    }
    rows = []
    for field in dataclasses.fields(cls):
        if cls is Corridor and field.name in PARTS:
            rows += _rows(hints[field.name])
        elif field.name in meanings and field.compare:  # else `resolve` fills it in
            allowed, meaning = values(hints[field.name]), meanings[field.name]
            rows.append(f"| `{field.name}` | {allowed} | {default(field)} | {meaning} |")
    return rows


def values(hint: Any) -> str:
    """Return the type and the range of an annotation in words, as error messages name them."""
    interval = None
    if typing.get_origin(hint) is typing.Annotated:
        hint, *extras = typing.get_args(hint)
        interval = next((extra for extra in extras if isinstance(extra, Interval)), None)
    origin, items = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(values, items)))
    if origin is typing.Literal:
        return " or ".join(f"`{json.dumps(item)}`" for item in items)
    if origin is tuple:
        if Ellipsis in items:
            return f"list, each {values(items[0])}"
        kinds = [*map(values, items)]
        alike = len(set(kinds)) == 1
        return f"{len(kinds)} items, each {kinds[0]}" if alike else f"({', '.join(kinds)})"
    if hint in (int, float):
        return allowed_numbers(hint, interval).removeprefix("an ").removeprefix("a ")
    words = {Any: "name or class", bool: "`True` or `False`", str: "text", types.NoneType: "`None`"}
    return words.get(hint, "mapping")


def default(field: dataclasses.Field[Any]) -> str:
    """Return the default of a field in Python; a dash where it has none."""
    value = field.default
    if value is dataclasses.MISSING:
        return "—" if field.default_factory is dataclasses.MISSING else "see below"
    if dataclasses.is_dataclass(value):
        return f'`"{value.name}"`' if hasattr(value, "name") else "see below"
    if isinstance(value, tuple) and len(value) > 8 and value == tuple(range(len(value))):
        return f'`"0:{len(value)}"`'
    return f"`{json.dumps(value) if isinstance(value, str | tuple) else repr(value)}`"


def command_list() -> str:
    """Return the commands in their groups, each with the example that its help begins with."""
    lines = []
    for group, commands in GROUPS.items():
        lines.append(f"### {group.capitalize()} {{#to-{group.replace(' ', '-')}}}\n")
        for name, meaning in commands.items():
            example = (import_module(MODULES[name]).__doc__ or "").split("\n\n")[1].strip()
            lines.append(f"**`{name}`**: {meaning}\n\n```bash\n{example}\n```\n")
    return "\n".join(lines)
