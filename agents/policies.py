"""Query policies by name: schedules, and saved policies with their cards.

torch and stable-baselines3 are imported when a saved policy is loaded, so that schedules and cards
need neither.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dptse_env.evaluation import Policy
from dptse_env.policies import DETERMINISTIC, SUFFIX, read_policy, shipped_policies
from dptse_env.schedules import SCHEDULES, make_schedule
from dptse_env.utils.files import file_digest
from dptse_env.utils.registry import require_registered
from dptse_env.utils.validation import require


@dataclass(frozen=True)
class NamedPolicy:
    """A query policy before it is bound to an environment.

    Attributes:
        source: The file of a saved policy, the name of one that comes with the package, or else a
            schedule: its name or ``"module:Class"``.
        card: Description of a saved policy, see `dptse_env.policies.PolicyFile`; None for a
            schedule.
    """

    source: str
    card: Mapping[str, Any] | None = None

    @property
    def is_schedule(self) -> bool:
        """True for what was not trained."""
        return self.card is None

    @property
    def identity(self) -> str:
        """The name of a schedule, of a class with its module's digest; a saved policy's digest.

        Raises:
            ValueError: The module cannot be imported.
        """
        if self.card is not None:
            return str(self.card["sha256"])
        if ":" not in self.source:
            return self.source
        try:
            file = importlib.import_module(self.source.partition(":")[0]).__file__
        except Exception as problem:
            raise ValueError(
                f"{self.source!r} cannot be imported: {type(problem).__name__}: {problem}"
            ) from problem
        return self.source if file is None else f"{self.source} {file_digest(file)}"

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of the environment that it fits: its actions, and its observation if named.

        Schedules speak every encoding. A class of one's own names them by an attribute
        ``keywords``.

        Raises:
            ValueError: A block of the observation is no registered name; or a class cannot be
                imported, or names other keywords.
        """
        if self.card is None:
            is_own, known = ":" in self.source, {"action", "observation"}
            named: Any = getattr(SCHEDULES.find(self.source), "keywords", {}) if is_own else {}
            fits = isinstance(named, Mapping) and {*named} <= known
            require(fits, f"{self.source}.keywords", "of action and observation", named)
            return {**named}
        own: dict[str, Any] = {"action": self.card["fits"]["action"]}
        if (blocks := self.card["keywords"].get("observation")) is not None:
            require_registered(blocks, f"{self.source}: keywords.observation")
            own["observation"] = blocks
        return own

    @property
    def deterministic(self) -> bool:
        """True if it takes its likeliest action unless told otherwise."""
        return self.card is None or bool(self.card["acts"] == DETERMINISTIC)

    def load(self, env: Any, *, allow: Collection[str] = (), seed: int | None = None) -> Policy:
        """Bind it to an environment.

        See `dptse_env.schedules.make_schedule` and `dptse_env.sb3.load_policy`.

        Raises:
            ValueError: It is unknown or does not fit the environment.
        """
        policy: Policy
        if self.card is None:
            policy = make_schedule(self.source, env, seed)
        else:
            from dptse_env.sb3 import load_policy  # noqa: PLC0415

            policy = load_policy(self.source, env, allow=allow)
        return policy


def policy_name(source: str) -> str:
    """Return the name of a policy in tables.

    Files of trainings have one name; their folders differ.
    """
    path = Path(source)
    is_file = path.suffix == SUFFIX
    return "/".join(filter(None, (path.parent.name, path.stem))) if is_file else source


def find_policy(source: str) -> NamedPolicy:
    """Return the policy that a name or a file stands for.

    A schedule is looked for when it is loaded.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: The file is not a saved policy.
    """
    if source.endswith((SUFFIX, ".zip")) or source in shipped_policies():
        return NamedPolicy(source, read_policy(source).card)
    return NamedPolicy(source)
