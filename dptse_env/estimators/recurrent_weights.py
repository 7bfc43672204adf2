"""Weights of recurrent networks as files: arrays and a card, read within bounds.

A file is a .npz archive of the arrays of a `Network` and of ``card``, JSON that says what the
network was trained on. It is read without pickles.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from dptse_env.estimators.recurrent_kernels import CHANNELS, Network, shapes
from dptse_env.utils.archive import open_archive, read_entry
from dptse_env.utils.fields import parse_object

LARGEST_FILE = 2**24
"""Largest size of a file and of its arrays together [bytes]; a network of width 32 has 60 kB."""

LARGEST_WIDTH = 512
FORMAT = "recurrent-2"
"""Name of the channels' order and meaning; another one is refused."""

_CARD = {
    "name": str,
    "format": str,
    "channels": list,
    "ranges": dict,
    "training": dict,
}
_FOLDER = "networks"


@dataclass(frozen=True)
class SavedNetwork:
    """A network with its card.

    Attributes:
        network: The weights.
        card: ``name``, ``format``, ``channels``, ``ranges`` and ``training``.
        sha256: Digest of the file.
        source: The file, or the name of a network that comes with the package.
    """

    network: Network
    card: Mapping[str, Any]
    sha256: str
    source: str


def shipped_networks() -> tuple[str, ...]:
    """Names of the networks that come with the package, sorted."""
    folder = files("dptse_env.estimators") / _FOLDER
    names = [entry.name for entry in folder.iterdir()]
    return tuple(sorted(name.removesuffix(".npz") for name in names if name.endswith(".npz")))


def member_for(source: str, flows: bool) -> str:
    """Return the network of a pair that suits releases of flows, or of speeds.

    A pair is two networks whose names, or files, are ``<source>-flows`` and ``<source>-speeds``. A
    name or file of a single network is returned as it is.
    """
    member = f"{source}-{'flows' if flows else 'speeds'}"
    if member in shipped_networks():
        return member
    return f"{member}.npz" if Path(f"{member}.npz").is_file() else source


def read_network(source: str) -> SavedNetwork:
    """Read a network, given by name or as a file.

    Raises:
        ValueError: There is no such name or file, or it is no saved network, or damaged.
    """
    if source in shipped_networks():
        return _shipped(source)
    if not Path(source).is_file():
        names = {name.removesuffix("-flows") for name in shipped_networks()}
        known = ", ".join(sorted(names.union(shipped_networks())))
        raise ValueError(
            f"estimator_settings.recurrent.weights must be a file or one of {known}, got {source!r}"
        )
    with Path(source).open("rb") as file:
        return parse_network(file.read(LARGEST_FILE + 1), source)


@cache
def _shipped(name: str) -> SavedNetwork:
    path = files("dptse_env.estimators") / _FOLDER / f"{name}.npz"
    return parse_network(path.read_bytes(), name)


def parse_network(content: bytes, source: str) -> SavedNetwork:
    """Return the network in the content of a file, named `source` in messages.

    Raises:
        ValueError: It is no saved network, has another layout, or is damaged.
    """
    try:
        if len(content) > LARGEST_FILE:
            raise ValueError(f"it has more than {LARGEST_FILE} bytes")
        with open_archive(content) as archive:
            arrays = {
                name: _read_array(read_entry(archive, f"{name}.npy", LARGEST_FILE))
                for name in ("card", *Network._fields)
            }
        card = _parse_card(arrays.pop("card"))
        network = _checked(arrays)
    except (
        zipfile.BadZipFile, zlib.error, EOFError, LookupError, OverflowError, MemoryError,
        RuntimeError, SyntaxError, tokenize.TokenError, TypeError, ValueError,
    ) as problem:  # fmt: skip
        raise ValueError(
            f"{source!r} is not a saved network, or damaged: {problem!s:.300}"
        ) from problem
    return SavedNetwork(network, card, hashlib.sha256(content).hexdigest(), source)


def write_network(path: str | os.PathLike[str], network: Network, card: Mapping[str, Any]) -> None:
    """Write a network with its card; the same arrays and card give the same bytes.

    Raises:
        ValueError: The network or its card has another layout; nothing is written.
    """
    text = json.dumps(dict(card), sort_keys=True).encode()
    arrays = {"card": np.frombuffer(text, dtype=np.uint8), **network._asdict()}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            entry = io.BytesIO()
            np.lib.format.write_array(entry, np.ascontiguousarray(array), allow_pickle=False)
            # The default time of an entry, 1980, keeps the bytes the same.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), entry.getvalue())
    parse_network(buffer.getvalue(), str(path))
    Path(path).write_bytes(buffer.getvalue())


def _read_array(content: bytes) -> Any:
    """Return the array in a .npy file, whose header must fit its length."""
    file = io.BytesIO(content)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("its arrays must be of version 1.0 of the format of numpy")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
    if dtype not in (np.float32, np.uint8) or by_columns:
        raise ValueError(f"its arrays must be float32 or uint8 by rows, got {dtype}")
    if math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError(f"an array of shape {shape} is truncated or too long")
    return np.frombuffer(content, dtype, offset=file.tell()).reshape(shape)


def _parse_card(array: np.ndarray[Any, Any]) -> dict[str, Any]:
    card = parse_object(array.astype(np.uint8).tobytes().decode(), "its card", _CARD)
    if card["format"] != FORMAT or tuple(card["channels"]) != CHANNELS:
        raise ValueError(
            f"it has channels of format {card['format']!r}, this version reads {FORMAT!r}"
        )
    for name, bounds in card["ranges"].items():
        numbers = isinstance(bounds, list) and len(bounds) == 2
        if not numbers or not all(isinstance(bound, int | float) for bound in bounds):
            raise ValueError(f"its card's range of {name!r} must be two numbers, got {bounds!r}")
    return card


def _checked(arrays: Mapping[str, Any]) -> Network:
    width = arrays["hidden"].shape[0] if arrays["hidden"].ndim == 2 else 0
    if not 1 <= width <= LARGEST_WIDTH:
        raise ValueError(f"its width must be in 1..{LARGEST_WIDTH}, got {width}")
    for name, shape in shapes(width).items():
        array = arrays[name]
        if array.dtype != np.float32 or array.shape != shape:
            raise ValueError(
                f"{name!r} must be float32 of shape {shape}, got {array.dtype} of {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{name!r} must be finite")
    return Network(**{name: np.ascontiguousarray(arrays[name]) for name in shapes(width)})
