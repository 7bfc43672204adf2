"""Optional packages: what is missing is named with the extra that brings it, in one sentence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

EXTRAS: Mapping[str, tuple[str, ...]] = {
    "train": (
        "optuna", "plotly", "polars", "rich", "sb3_contrib", "stable_baselines3", "torch",
        "tyro",
    ),
    "corridors": ("polars", "sumo"),
    "ray": ("ray",),
    "video": ("moviepy", "pygame"),
}  # fmt: skip
"""Modules that each extra brings. `sumo` comes with eclipse-sumo."""


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
