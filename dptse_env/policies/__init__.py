"""Saved policies: weights with a card, read without torch; some come with the package."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dptse_env.utils.arrays import AnyArray
from dptse_env.utils.files import read_tensors
from dptse_env.utils.registry import require_registered
from dptse_env.utils.validation import require_name

SUFFIX = ".safetensors"
"""Ending of the names of files with weights."""

TRANSFERABLE = ("corridor", "bandwidth", "privacy")
"""Properties that a caller may allow to differ between a policy and its environment. Another
release (``privacy``) is told of where it is not allowed, and the others are refused."""

DETERMINISTIC, DRAWN = "deterministic", "drawn"
"""Modes of a policy on its card: it takes its likeliest action, or draws one."""

_FOLDER = Path(__file__).parent
_FIELDS: Mapping[str, type] = {
    "fits": dict, "fits.action": str, "fits.corridor": str, "fits.privacy": dict,
    "policy": dict, "policy.class": str, "policy.arguments": dict, "acts": str, "env": str,
    "keywords": dict, "trained_on": str, "training": dict,
}  # fmt: skip
"""Fields that a card must have, with their types."""


@dataclass(frozen=True)
class PolicyFile:
    """The content of a policy file, read without torch.

    Attributes:
        source: The file, or the name of a policy that comes with the package.
        card: Description of the policy: its class, its training, and the environments it fits.
        weights: Arrays by name; all values are finite.
    """

    source: str
    card: Mapping[str, Any]
    weights: Mapping[str, AnyArray]

    @property
    def identity(self) -> str:
        """Digest of card and weights, by which recorded results know it."""
        return str(self.card["sha256"])


def shipped_policies() -> list[str]:
    """Return the names of the policies that come with the package."""
    return sorted(path.stem for path in _FOLDER.glob(f"*{SUFFIX}"))


def seed_ranges(seeds: Sequence[int]) -> str:
    """Return traffic seeds as a card has them, ``"0..63, 70"``."""
    known = set(seeds)
    ordered = sorted(known)
    starts = [seed for seed in ordered if seed - 1 not in known]
    ends = [seed for seed in ordered if seed + 1 not in known]
    pairs = zip(starts, ends, strict=True)
    return ", ".join(f"{low}..{high}" if low < high else f"{low}" for low, high in pairs)


def read_policy(source: str | os.PathLike[str]) -> PolicyFile:
    """Read a saved policy.

    Args:
        source: The name of a policy that comes with the package, or a file.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is not a saved policy, is damaged, exceeds a limit of
            `dptse_env.utils.files`, or names its action by an import string.
    """
    name, path = os.fspath(source), Path(source)
    if name in shipped_policies():
        path = _FOLDER / f"{name}{SUFFIX}"
    elif not path.exists():
        known = ", ".join(shipped_policies()) or "none"
        raise FileNotFoundError(
            f"there is no saved policy {name!r}: neither a file, nor one of those that come with "
            f"the package ({known})"
        )
    if path.suffix == ".zip":
        raise ValueError(
            f"{name} is no saved policy; dptse import policy makes one of a model of "
            "stable-baselines3"
        )
    card, weights = read_tensors(path)
    for field, kind in _FIELDS.items():
        value: Any = card
        for key in field.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if not isinstance(value, kind):
            raise ValueError(
                f"{name} is not a saved policy: its card must have a field {field!r} of type "
                f"{kind.__name__}"
            )
    require_registered(card["fits"]["action"], f"{name}: fits.action")
    require_name(f"{name}: acts", card["acts"], (DETERMINISTIC, DRAWN))
    return PolicyFile(name, card, weights)
