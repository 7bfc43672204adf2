"""Lookup by name: parts, also as ``"package.module:Name"``, plugins, optional packages."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import entry_points
from typing import Any

from dptse_env.utils.validation import cut, require, shown

PLUGINS = "dptse_env.plugins"
"""Group of entry points of other packages. Each names a function that registers their parts; it is
called once, when a name is looked up that is not known yet."""

_PACKAGE = __name__.partition(".")[0]
_plugins_loaded = False


class Registry(Mapping[str, Any]):
    """The parts of one kind.

    A part is given as its name, as ``"package.module:Name"``, or as the part itself. Strings travel
    in JSON; a registered name is known in every process that imports the package which registers
    it, ``"package.module:Name"`` everywhere.

    Attributes:
        keyword: Path of the configuration's keyword, for messages.
    """

    def __init__(
        self,
        keyword: str,
        shipped: Mapping[str, Any],
        check: Callable[[Any], str | None],
    ) -> None:
        """Hold the parts that ship with the package.

        Args:
            keyword: Path of the keyword.
            shipped: Parts by name; a string ``"module:Name"`` is imported when it is looked up.
            check: Returns the requirement that a part of another package misses, worded to follow
                "must", or None.
        """
        self.keyword, self._check = keyword, check
        self._parts = dict(shipped)
        self._shipped = frozenset(shipped)

    def __getitem__(self, name: str) -> Any:
        """Return the part of a name."""
        return self._parts[name]

    def __iter__(self) -> Iterator[str]:
        """Return the names."""
        return iter(self._parts)

    def __len__(self) -> int:
        """Return how many parts there are."""
        return len(self._parts)

    def register(self, name: str, part: Any) -> None:
        """Give a part a name.

        Args:
            name: Lower-case letters, digits, hyphens and underscores; none that is taken.
            part: The part, or ``"package.module:Name"``.

        Raises:
            ValueError: The name is malformed or taken, or the part lacks something.
        """
        if not isinstance(name, str) or not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name):
            raise ValueError(
                f"{self.keyword}: a name must be lower-case letters, digits, '-' and '_', got "
                f"{name!r}"
            )
        if name in self._shipped:
            raise ValueError(f"{self.keyword}: {name!r} ships with {_PACKAGE}, choose another name")
        if self._parts.get(name, part) != part:
            raise ValueError(f"{self.keyword}: {name!r} is registered already, for another part")
        if not isinstance(part, str):
            self._require(part)
        self._parts[name] = part

    def find(self, value: Any) -> Any:
        """Return the part that a keyword's value stands for.

        Args:
            value: A name, ``"package.module:Name"``, or a part, which is returned as it is.

        Raises:
            ValueError: There is no such name, it cannot be imported, or the part lacks something.
        """
        part = value
        if isinstance(value, str):
            name = self.name_of(value)
            part = self._parts.get(name, name)
            if isinstance(part, str):
                part = self._imported(part)
        is_shipped = isinstance(value, str) and value in self._shipped
        if not (is_shipped or any(part is own for own in self._parts.values())):
            self._require(part)
        return part

    def name_of(self, value: Any) -> str:
        """Return the name of a part in reports: as registered, or ``"package.module:Name"``.

        Raises:
            ValueError: A string is neither a name nor of that form.
        """
        if not isinstance(value, str):
            return next((n for n, part in self._parts.items() if part is value), None) or (
                name_of_class(value)
            )
        if value not in self._parts and ":" not in value:
            load_plugins()
            names = f"one of {', '.join(self._parts)}, or, outside of files, 'package.module:Name'"
            require(value in self._parts, self.keyword, names, value)
        return value

    def _imported(self, path: str) -> Any:
        module, _, name = path.partition(":")
        try:
            imported = importlib.import_module(module)
        except Exception as problem:
            raise ValueError(
                f"{self.keyword} {path!r} cannot be imported: {type(problem).__name__}: {problem}"
            ) from problem
        found: Any = imported
        try:
            for attribute in name.split("."):
                found = getattr(found, attribute)
        except AttributeError as problem:
            place = getattr(imported, "__file__", None) or [*getattr(imported, "__path__", [])]
            raise ValueError(
                f"{self.keyword} {path!r} cannot be imported: {module} has no {name!r}; it is at "
                f"{place}"
            ) from problem
        return found

    def _require(self, part: Any) -> None:
        expected = self._check(part)
        if expected is None:
            return
        if type(part).__module__ == "builtins" and not hasattr(part, "__qualname__"):
            raise ValueError(f"{self.keyword} must {expected}, got {shown(part)}")
        raise ValueError(f"{self.keyword} {name_of_class(part)} must {expected}")


def require_registered(value: Any, path: str) -> None:
    """Refuse a value from a file that has ``"module:Name"`` in it; nothing is imported.

    Raises:
        ValueError: It does, perhaps in a nested value; the message starts with its path.
    """
    if isinstance(value, str):
        allowed = "a registered name (import strings come from Python or the command line alone)"
        require(":" not in value, path, allowed, value)
    elif isinstance(value, Mapping):
        for key, each in value.items():
            require_registered(each, f"{path}.{cut(key)}")
    elif isinstance(value, list):
        for i, each in enumerate(value):
            require_registered(each, f"{path}[{i}]")


def name_of_class(part: Any) -> str:
    """Return ``"package.module:Name"`` of a class or function, or of the class of an object."""
    if isinstance(part, str):
        return repr(part)
    named = part if hasattr(part, "__qualname__") else type(part)
    return f"{named.__module__}:{named.__qualname__}"


def is_foreign(part: Any) -> bool:
    """Return whether a class, function or object comes from outside this package."""
    return name_of_class(part).split(":")[0].partition(".")[0] != _PACKAGE


def missing_methods(part: Any, methods: tuple[str, ...]) -> str | None:
    """Return "have f(), g()" for the ``methods`` that a class or object lacks, or None."""
    lacking = [name for name in methods if not callable(getattr(part, name, None))]
    return f"have {', '.join(f'{name}()' for name in lacking)}" if lacking else None


def load_plugins() -> None:
    """Call the functions by which installed packages register their parts, once a process."""
    global _plugins_loaded  # noqa: PLW0603 (a process imports its plugins once)
    if _plugins_loaded:
        return
    _plugins_loaded = True
    for entry in entry_points(group=PLUGINS):
        entry.load()()


EXTRAS: Mapping[str, tuple[str, ...]] = {
    "plot": ("matplotlib",),
    "train": (
        "optuna", "plotly", "polars", "rich", "sb3_contrib", "stable_baselines3", "tomlkit",
        "torch", "tyro",
    ),
    "corridors": ("polars", "sumo"),
    "reference": ("filterpy", "piqp", "qpsolvers"),
    "ray": ("ray",),
    "video": ("moviepy", "pygame"),
}  # fmt: skip
"""Modules that each extra brings beside those of other extras; `train`, `corridors` and `video`
bring `plot`, too. `sumo` comes with eclipse-sumo."""


class MissingExtraError(ImportError):
    """An optional package is not installed; the message says how to install it."""


@contextmanager
def needed_for(purpose: str) -> Iterator[None]:
    """Name the extra if an import in the body fails because an optional package is missing.

    An import that fails for another reason keeps its error.

    Args:
        purpose: What the imports are for, such as "an HTML page".

    Raises:
        MissingExtraError: A module of `EXTRAS` is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as problem:
        module = (problem.name or "").partition(".")[0]
        if not any(module in modules for modules in EXTRAS.values()):
            raise
        raise missing_extra(module, purpose) from problem


def missing_extra(module: str, purpose: str) -> MissingExtraError:
    """Return the error for a module of `EXTRAS` that is not installed."""
    bringing = [f"'dptse-env[{extra}]'" for extra, modules in EXTRAS.items() if module in modules]
    return MissingExtraError(
        f"{purpose} needs {module}, which is not installed: pip install {' or '.join(bringing)}"
    )
