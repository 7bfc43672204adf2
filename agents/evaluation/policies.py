"""Query policies by name: schedules, and saved policies with their cards.

torch and stable-baselines3 are imported when a saved policy is loaded, so that schedules and cards
need neither.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import Policy
from dptse_env.policies import read_policy, shipped_policies
from dptse_env.schedules import make_schedule


@dataclass(frozen=True)
class NamedSchedule:
    """A query schedule by its name or the file of its plan."""

    source: str

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords that an environment needs for it: none, schedules speak every encoding."""
        return {}

    @property
    def identity(self) -> str:
        """The name."""
        return self.source

    def load(self, env: Any, *, allow: Collection[str] = (), seed: int | None = None) -> Policy:
        """Bind the schedule to an environment, see `dptse_env.schedules.make_schedule`.

        Raises:
            ValueError: The name is unknown or the schedule does not suit the environment.
        """
        policy: Policy = make_schedule(self.source, env, seed)
        return policy


@dataclass(frozen=True)
class SavedPolicy:
    """A saved policy, as far as its file can be read without torch.

    Attributes:
        source: The file, or the name of a policy that comes with the package.
    """

    source: str
    sha256: str
    card: Mapping[str, Any]

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords that an environment needs for it: its action encoding."""
        return {"action": self.action}

    @property
    def identity(self) -> str:
        """Digest of the file, which tells policies apart whatever their files are called."""
        return self.sha256

    @property
    def action(self) -> str:
        """The action encoding of the policy."""
        return str(self.card["fits"]["action"])

    @property
    def recipe(self) -> str:
        """Name of the recipe that trained it."""
        return str(self.card["training"]["learner"])

    @property
    def training_seed(self) -> int:
        """Seed of its training."""
        return int(self.card["training"]["seed"])

    def load(self, env: Any, *, allow: Collection[str] = (), seed: int | None = None) -> Policy:
        """Bind the policy to an environment, see `dptse_env.sb3.load_policy`.

        Raises:
            ValueError: It does not fit the environment, or the file has changed since.
        """
        from dptse_env.sb3 import load_policy  # noqa: PLC0415

        present = read_policy(self.source).sha256
        if present != self.sha256:
            raise ValueError(f"{self.source!r} has changed: sha256 {present}, it was {self.sha256}")
        policy: Policy = load_policy(self.source, env, allow=allow)
        return policy


PolicySource = NamedSchedule | SavedPolicy
"""A query policy before it is bound to an environment."""


def find_policy(source: str) -> PolicySource:
    """Return the policy that a name or a file stands for.

    Args:
        source: The ``.zip`` file of a saved policy, the name of one that comes with the package, or
            else a schedule: its name or the ``.json`` file of a plan. Whether a schedule exists and
            suits an environment is checked when it is loaded.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: The file is not a saved policy.
    """
    if source.endswith(".zip") or source in shipped_policies():
        return read_saved_policy(source)
    return NamedSchedule(source)


def read_saved_policy(source: str | Path) -> SavedPolicy:
    """Read the card of a saved policy.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is not a saved policy.
    """
    file = read_policy(source)
    saved = SavedPolicy(file.source, file.sha256, file.card)
    try:
        # The entries of the card that the properties rely on must be there.
        _ = saved.recipe, saved.training_seed
    except (KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{file.source!r} is not a saved policy: {problem!r}") from problem
    return saved
