"""Conversion of per-episode info between batch rows, scalar dicts and Gymnasium's vector form.

*Rows* of k episodes are a dict of arrays with a leading axis of length k, or of such dicts.
Gymnasium's vector form has arrays over all n episodes and, under the same key with a leading
underscore, the flags of the episodes that have a value.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dptse_env.utils.arrays import IntArray

Rows = dict[str, Any]


def row_of(rows: Mapping[str, Any], k: int) -> dict[str, Any]:
    """Return row k, as plain Python numbers and as fresh arrays where a value has a shape."""
    return {
        key: row_of(value, k)
        if type(value) is dict
        else (value.item(k) if value.ndim == 1 else value[k].copy())
        for key, value in rows.items()
    }


def object_array(values: list[Any]) -> NDArray[np.object_]:
    """Return an array of k objects, which may be arrays and lists themselves."""
    objects = np.empty(len(values), dtype=object)
    for k, value in enumerate(values):
        objects[k] = value
    return objects


def repeated_rows(info: Mapping[str, Any], k: int) -> Rows:
    """Return the rows of k episodes that have the same info; lists and dicts are shared."""
    rows: Rows = {}
    for key, value in info.items():
        if isinstance(value, Mapping):
            rows[key] = repeated_rows(value, k)
        elif isinstance(value, bool | int | float):
            rows[key] = np.full(k, value)
        else:
            rows[key] = object_array([value] * k)
    return rows


def in_vector_form(rows: Mapping[str, Any], episodes: IntArray, n_episodes: int) -> dict[str, Any]:
    """Spread rows over all episodes, in the form of `gymnasium.vector.VectorEnv`.

    Args:
        rows: Infos of ``episodes``.
        episodes: Indices, ascending, shape (k,).
        n_episodes: Size of the batch n.

    Returns:
        Under each key an array of shape (n, ...), zero or None where an episode has no value, and
        under ``_key`` the flags of those that have one, shape (n,).
    """
    present = np.zeros(n_episodes, dtype=bool)
    present[episodes] = True
    infos: dict[str, Any] = {}
    for key, value in rows.items():
        if isinstance(value, Mapping):
            infos[key] = in_vector_form(value, episodes, n_episodes)
        elif len(episodes) == n_episodes:  # all of them, in order
            infos[key] = value.copy()
        else:
            blank = None if value.dtype == object else 0
            infos[key] = np.full((n_episodes, *value.shape[1:]), blank, dtype=value.dtype)
            infos[key][episodes] = value
        infos[f"_{key}"] = present.copy()
    return infos
