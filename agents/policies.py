"""Query policies by name: schedules, and saved policies with their cards.

torch and stable-baselines3 are imported when a saved policy is loaded, so that schedules and cards
need neither.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

from dptse_env.evaluation import Policy
from dptse_env.policies import DETERMINISTIC, SUFFIX, read_policy, shipped_policies
from dptse_env.schedules import make_schedule
from dptse_env.utils.files import file_digest
from dptse_env.utils.registry import require_registered


@dataclass(frozen=True)
class NamedSchedule:
    """A query schedule by its name, or its class as ``"module:Class"``."""

    source: str
    deterministic: ClassVar[bool] = True

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of the environment that it fits: none, schedules speak every encoding."""
        return {}

    @property
    def identity(self) -> str:
        """The name; of a class the digest of its module, too.

        Raises:
            ValueError: The module cannot be imported.
        """
        if ":" not in self.source:
            return self.source
        file = _imported(self.source).__file__
        return self.source if file is None else f"{self.source} {file_digest(file)}"

    def load(self, env: Any, *, allow: Collection[str] = (), seed: int | None = None) -> Policy:
        """Bind the schedule to an environment, see `dptse_env.schedules.make_schedule`.

        Raises:
            ValueError: The name is unknown or the schedule does not suit the environment.
        """
        policy: Policy = make_schedule(self.source, env, seed)
        return policy


def _imported(source: str) -> ModuleType:
    """Return the module of ``"module:Name"``; whatever it raises is a `ValueError`."""
    try:
        return importlib.import_module(source.partition(":")[0])
    except Exception as problem:
        raise ValueError(
            f"{source!r} cannot be imported: {type(problem).__name__}: {problem}"
        ) from problem


@dataclass(frozen=True)
class SavedPolicy:
    """A saved policy, as far as its file can be read without torch.

    Attributes:
        source: The file, or the name of a policy that comes with the package.
        card: Description of the policy, see `dptse_env.policies.PolicyFile`.
    """

    source: str
    card: Mapping[str, Any]

    @property
    def identity(self) -> str:
        """Digest that tells policies apart whatever their files are called."""
        return str(self.card["sha256"])

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of the environment that it fits: its actions, and its observation if named.

        Raises:
            ValueError: A block of the observation is no registered name.
        """
        own: dict[str, Any] = {"action": self.action}
        if (blocks := self.card["keywords"].get("observation")) is not None:
            require_registered(blocks, f"{self.source}: keywords.observation")
            own["observation"] = blocks
        return own

    @property
    def action(self) -> str:
        """The action encoding of the policy."""
        return str(self.card["fits"]["action"])

    @property
    def deterministic(self) -> bool:
        """True if it takes its likeliest action unless told otherwise."""
        return bool(self.card["acts"] == DETERMINISTIC)

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

        present = read_policy(self.source).identity
        if present != self.identity:
            raise ValueError(
                f"{self.source!r} has changed: sha256 {present}, it was {self.identity}"
            )
        policy: Policy = load_policy(self.source, env, allow=allow)
        return policy


PolicySource = NamedSchedule | SavedPolicy
"""A query policy before it is bound to an environment."""


def policy_name(source: str) -> str:
    """Return the name of a policy in tables.

    Files of trainings have one name; their folders differ.
    """
    path = Path(source)
    return f"{path.parent.name}/{path.stem}" if path.suffix == SUFFIX else source


def find_policy(source: str) -> PolicySource:
    """Return the policy that a name or a file stands for.

    Args:
        source: The ``.safetensors`` file of a saved policy, the name of one that comes with the
            package, or else a schedule: its name or ``"module:Class"``. Whether a schedule exists
            and suits an environment is checked when it is loaded.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: The file is not a saved policy.
    """
    if source.endswith((SUFFIX, ".zip")) or source in shipped_policies():
        return read_saved_policy(source)
    return NamedSchedule(source)


def read_saved_policy(source: str | Path) -> SavedPolicy:
    """Read the card of a saved policy.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is not a saved policy.
    """
    file = read_policy(source)
    saved = SavedPolicy(file.source, file.card)
    try:
        # The entries of the card that the properties rely on must be there.
        _ = saved.recipe, saved.training_seed
    except (KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{file.source!r} is not a saved policy: {problem!r}") from problem
    return saved
