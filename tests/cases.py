"""Choices among many cases: a few for every run, the rest among the slow ones."""

from collections.abc import Iterable
from typing import Any

import pytest


def chosen(fast: Iterable[Any], every: Iterable[Any]) -> list[Any]:
    """Return the chosen cases as they are, and every other one marked as slow."""
    fast = list(fast)
    rest = [case for case in every if case not in fast]
    packed = (case if isinstance(case, tuple) else (case,) for case in rest)
    return [*fast, *(pytest.param(*case, marks=pytest.mark.slow) for case in packed)]
