"""Tensors written by ``torch.save``, read without torch."""

import math
import zipfile

import numpy as np
from numpy.typing import NDArray

from dptse_env.policies.tensor_table import TensorEntry, read_table
from dptse_env.utils.archive import read_entry

MOST_TENSORS = 256
"""Largest number of tensors in a file."""

LARGEST_TABLE = 2**16
"""Largest size of the table of tensors [bytes]."""

_ITEM = 4
"""Size of a float32 [bytes]."""


def read_tensors(archive: zipfile.ZipFile, largest: int) -> dict[str, NDArray[np.float32]]:
    """Return the float32 tensors of an archive by name, as written by ``torch.save``.

    Raises:
        ValueError: The archive has another content, values are not finite, or have more than
            `largest` bytes in all.
        KeyError: An entry of the archive is missing.
    """
    tables = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    if len(tables) != 1:
        raise ValueError(f"its weights must have one table of tensors, got {len(tables)}")
    folder = tables[0].removesuffix("data.pkl")
    order = f"{folder}byteorder"
    if order in archive.namelist() and read_entry(archive, order, 16) != b"little":
        raise ValueError("its weights must be in little-endian order")
    tensors = read_table(read_entry(archive, tables[0], LARGEST_TABLE))
    if not 1 <= len(tensors) <= MOST_TENSORS:
        raise ValueError(f"it must have 1..{MOST_TENSORS} tensors of weights, got {len(tensors)}")
    # Tensors may share a storage, and two may disagree about its size.
    sizes: dict[str, int] = {}
    for tensor in tensors.values():
        size = _ITEM * tensor.storage.n_values
        if sizes.setdefault(tensor.storage.key, size) != size:
            raise ValueError("its table of weights is damaged")
    n_values = sum(math.prod(tensor.shape) for tensor in tensors.values())
    if max(sum(sizes.values()), _ITEM * n_values) > largest:
        raise ValueError(f"its weights have more than {largest} bytes")
    contents = {
        key: read_entry(archive, f"{folder}data/{key}", size) for key, size in sizes.items()
    }
    return {
        name: _array(name, tensor, contents[tensor.storage.key]) for name, tensor in tensors.items()
    }


def _array(name: str, tensor: TensorEntry, content: bytes) -> NDArray[np.float32]:
    """Return the values of a tensor, given the content of its storage."""
    count = math.prod(tensor.shape)
    if _ITEM * (tensor.offset + count) > len(content):
        raise ValueError(f"weight {name!r} reaches beyond its storage")
    stored = np.frombuffer(content, "<f4", count, _ITEM * tensor.offset)
    values: NDArray[np.float32] = stored.astype(np.float32).reshape(tensor.shape)
    if not np.isfinite(values).all():
        raise ValueError(f"weight {name!r} must be finite, it has NaN or infinite values")
    return values
