"""Cases of parametrised tests: a few for every run, and the rest among the slow ones."""

from collections.abc import Collection, Iterable
from itertools import combinations, product
from typing import Any

import pytest


def fast_and_slow(cases: Iterable[Any], fast: Collection[Any]) -> list[Any]:
    """Return cases as parameters, marked slow where they are not among the fast ones.

    A case is one value, or a tuple of one for each argument.
    """
    return [_parameter(case, slow=case not in fast) for case in cases]


def pairwise(*axes: Iterable[Any], n: int = 6, rest: bool = True) -> list[Any]:
    """Return the product of axes as parameters, of which `n` are fast and the rest slow.

    The fast ones are those in which every value occurs, and as many pairs of values of two axes as
    possible, in the order of the product.

    Args:
        axes: Values of each argument.
        n: Number of fast cases.
        rest: Whether to keep the others, as slow ones. They pay where they can find what the fast
            ones cannot.
    """
    values = [list(axis) for axis in axes]
    waiting = list(product(*(range(len(axis)) for axis in values)))
    chosen, covered = [], set()
    while waiting and len(chosen) < n:
        best = max(waiting, key=lambda indices: _gain(indices, covered))
        waiting.remove(best)
        chosen.append(best)
        covered |= _covered(best)
    return [
        _parameter(tuple(axis[i] for axis, i in zip(values, indices, strict=True)), slow=slow)
        for slow, group in ((False, sorted(chosen)), (True, waiting if rest else []))
        for indices in group
    ]


def _covered(indices: tuple[int, ...]) -> set[Any]:
    """Return the values and the pairs of values of a case."""
    values = list(enumerate(indices))
    return {*values, *combinations(values, 2)}


def _gain(indices: tuple[int, ...], covered: set[Any]) -> tuple[int, int]:
    new = _covered(indices) - covered
    return sum(isinstance(item[0], int) for item in new), len(new)


def _parameter(case: Any, slow: bool) -> Any:
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=[pytest.mark.slow] if slow else [])
