"""Saved policies: what their cards say, and how one is bound to an environment.

torch and stable-baselines3 are imported where a policy is loaded, so that schedules alone need
neither.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import Policy
from dptse_env.policies import CARD, read_policy


@dataclass(frozen=True)
class Saved:
    """A saved policy, as far as its file says without torch.

    Attributes:
        source: The file, or the name of a policy that comes with the package.
        sha256: Digest of the file.
        card: Its card.
    """

    source: str
    sha256: str
    card: Mapping[str, Any]

    @classmethod
    def of(cls, source: str | Path) -> Saved:
        """Read the card of a saved policy.

        Raises:
            FileNotFoundError: There is no such file, nor such a name.
            ValueError: The file is no saved policy.
        """
        content = read_policy(source)
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                card = json.loads(archive.read(CARD))
            # What is relied on further below must be there.
            saved = cls(str(source), hashlib.sha256(content).hexdigest(), card)
            _ = saved.action, saved.recipe, saved.training_seed
        except (zipfile.BadZipFile, KeyError, TypeError, ValueError) as problem:
            raise ValueError(f"{str(source)!r} is no saved policy: {problem!r}") from problem
        return saved

    @property
    def action(self) -> str:
        """The action encoding that it speaks."""
        return str(self.card["fits"]["action"])

    @property
    def recipe(self) -> str:
        """Name of the recipe that it was trained by."""
        return str(self.card["training"]["learner"])

    @property
    def training_seed(self) -> int:
        """Seed of its training."""
        return int(self.card["training"]["seed"])

    def load(self, env: Any, *, allow: Collection[str] = ()) -> Policy:
        """Bind the policy to an environment, see `dptse_env.sb3.load_policy`.

        Raises:
            ValueError: It does not fit the environment, or the file has changed since.
        """
        from dptse_env.sb3 import load_policy  # noqa: PLC0415

        now = hashlib.sha256(read_policy(self.source)).hexdigest()
        if now != self.sha256:
            raise ValueError(f"{self.source!r} has changed: sha256 {now}, it was {self.sha256}")
        policy: Policy = load_policy(self.source, env, allow=allow)
        return policy
