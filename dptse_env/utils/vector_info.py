"""What is said beside observations, for many episodes at once and for one.

Inside, the infos of k episodes are *rows*: a dict of arrays with a leading axis of length k, or of
such dicts. Gymnasium's vector form spreads them over all n episodes and marks, under the key with
an underscore before it, which of them a value was said of.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dptse_env.utils.arrays import IntArray

Rows = dict[str, Any]


def row_of(rows: Mapping[str, Any], k: int) -> dict[str, Any]:
    """Return row k as plain Python numbers, and as fresh arrays where a value has a shape."""
    return {
        key: row_of(value, k)
        if isinstance(value, Mapping)
        else (value.item(k) if value.ndim == 1 else value[k].copy())
        for key, value in rows.items()
    }


def as_objects(values: list[Any]) -> NDArray[np.object_]:
    """Return an array that holds the k values as they are, arrays and lists too."""
    objects = np.empty(len(values), dtype=object)
    for k, value in enumerate(values):
        objects[k] = value
    return objects


def repeated(info: Mapping[str, Any], k: int) -> Rows:
    """Return the rows of k episodes of which the same is said; lists and dicts are shared."""
    rows: Rows = {}
    for key, value in info.items():
        if isinstance(value, Mapping):
            rows[key] = repeated(value, k)
        elif isinstance(value, bool | int | float):
            rows[key] = np.full(k, value)
        else:
            rows[key] = as_objects([value] * k)
    return rows


def in_vector_form(rows: Mapping[str, Any], episodes: IntArray, n_episodes: int) -> dict[str, Any]:
    """Spread rows over all episodes, in the form of `gymnasium.vector.VectorEnv`.

    Args:
        rows: What is said of ``episodes``.
        episodes: Which they are, shape (k,).
        n_episodes: Size of the batch n.

    Returns:
        Under each key an array of shape (n, ...), zero or None where nothing is said, and under
        ``_key`` whether something is, shape (n,).
    """
    said = np.zeros(n_episodes, dtype=bool)
    said[episodes] = True
    infos: dict[str, Any] = {}
    for key, value in rows.items():
        if isinstance(value, Mapping):
            infos[key] = in_vector_form(value, episodes, n_episodes)
        else:
            blank = None if value.dtype == object else 0
            infos[key] = np.full((n_episodes, *value.shape[1:]), blank, dtype=value.dtype)
            infos[key][episodes] = value
        infos[f"_{key}"] = said.copy()
    return infos
