"""Conversion of per-episode info between batches, scalar dicts and Gymnasium's vector form.

*Infos* of k episodes are a dict of arrays with a leading axis of length k. Gymnasium's vector form
has arrays over all n episodes and, under the same key with a leading underscore, the flags of the
episodes that have a value.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dptse_env.utils.arrays import IntArray

Infos = dict[str, Any]


def info_of(infos: Mapping[str, Any], k: int) -> dict[str, Any]:
    """Return the info of the k-th of some episodes: plain numbers, and fresh arrays of others."""
    return {
        key: value.item(k) if value.ndim == 1 else value[k].copy() for key, value in infos.items()
    }


def object_array(values: list[Any]) -> NDArray[np.object_]:
    """Return an array of k objects, which may be arrays and lists themselves."""
    objects = np.empty(len(values), dtype=object)
    for k, value in enumerate(values):
        objects[k] = value
    return objects


def in_vector_form(given: Mapping[str, Any], episodes: IntArray, n_episodes: int) -> dict[str, Any]:
    """Spread infos over all episodes, in the form of `gymnasium.vector.VectorEnv`.

    Args:
        given: Infos of ``episodes``.
        episodes: Indices, ascending, shape (k,).
        n_episodes: Size of the batch n.

    Returns:
        Under each key an array of shape (n, ...), zero or None where an episode has no value, and
        under ``_key`` the flags of those that have one, shape (n,).
    """
    present = np.zeros(n_episodes, dtype=bool)
    present[episodes] = True
    infos: dict[str, Any] = {}
    for key, value in given.items():
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
