"""Reading of policy files within bounds of time and memory, for files of unknown origin."""

import hashlib
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dptse_env.policies.tensors import read_tensors
from dptse_env.utils.archive import open_archive, read_entry

CARD, WEIGHTS = "card.json", "weights.pt"
"""Entries of a policy file: its card, plain JSON that describes the policy, and its weights."""

LARGEST_FILE = 2**24
"""Largest size of a file and of its weights [bytes]; the shipped policy has 77 kB."""

LARGEST_CARD = 2**16
"""Largest size of a card [bytes]."""

DEEPEST_CARD = 16
"""Largest nesting of a card."""

LONGEST_TEXT = 2000
"""Largest length of the texts in a card that messages quote."""

_FIELDS: Mapping[str, type] = {
    "fits": dict, "fits.format": str, "fits.observation": str, "fits.action": str,
    "fits.corridor": str, "fits.bandwidth": int, "policy": dict, "policy.class": str,
    "policy.arguments": dict, "env": str, "keywords": dict, "corridor": str, "training": dict,
}  # fmt: skip
"""Fields that a card must have, with their types."""


@dataclass(frozen=True)
class PolicyFile:
    """The content of a policy file, read without torch.

    Attributes:
        source: The file, or the name of a policy that comes with the package.
        sha256: Digest of the file.
        card: Description of the policy: its class, its training, and the environments it fits.
        weights: Arrays by name; all values are finite.
    """

    source: str
    sha256: str
    card: Mapping[str, Any]
    weights: Mapping[str, NDArray[np.float32]]


def parse_policy(content: bytes, source: str) -> PolicyFile:
    """Return the policy in the content of a file, named `source` in error messages.

    Raises:
        ValueError: It is not a saved policy, is damaged, or exceeds a limit of this module.
    """
    try:
        if len(content) > LARGEST_FILE:
            raise ValueError(f"it has more than {LARGEST_FILE} bytes")
        with open_archive(content) as archive:
            card = _parse_card(read_entry(archive, CARD, LARGEST_CARD))
            weights = read_entry(archive, WEIGHTS, LARGEST_FILE)
        with open_archive(weights) as archive:
            tensors = read_tensors(archive, LARGEST_FILE)
    # All exceptions of Python's modules on damaged archives.
    except (
        zipfile.BadZipFile, zlib.error, struct.error, EOFError, LookupError, OverflowError,
        RuntimeError, ValueError,
    ) as problem:  # fmt: skip
        raise ValueError(
            f"{source!r} is not a saved policy, or damaged: {problem!s:.300}"
        ) from problem
    return PolicyFile(source, hashlib.sha256(content).hexdigest(), card, tensors)


def _parse_card(content: bytes) -> dict[str, Any]:
    """Return a card whose fields have the right types.

    Raises:
        ValueError: It is no JSON, nested too deeply, or a field is missing or of another type.
    """
    try:
        card = json.loads(content, parse_constant=_refuse_constant)
        is_deep = _depth(card) > DEEPEST_CARD
    except RecursionError:
        is_deep = True
    if is_deep:
        raise ValueError(f"its card is nested more than {DEEPEST_CARD} levels deep")
    for path, kind in _FIELDS.items():
        value = card
        for key in path.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ValueError(f"its card must have a field {path!r} of type {kind.__name__}")
        if isinstance(value, str) and len(value) > LONGEST_TEXT:
            raise ValueError(f"field {path!r} of its card has more than {LONGEST_TEXT} characters")
    checked: dict[str, Any] = card
    return checked


def _depth(node: Any) -> int:
    if isinstance(node, dict):
        node = node.values()
    elif not isinstance(node, list):
        return 1
    return 1 + max(map(_depth, node), default=0)


def _refuse_constant(name: str) -> float:
    raise ValueError(f"its card must have finite numbers, got {name}")
