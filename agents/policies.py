"""Query policies by name: schedules, saved policies with their cards, and saved models.

torch and stable-baselines3 are imported when a saved policy is loaded, so that schedules and cards
need neither.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from gymnasium import spaces

from dptse_env.evaluation import Policy
from dptse_env.policies import SUFFIX, read_policy, shipped_policies
from dptse_env.schedules import make_schedule
from dptse_env.utils.files import file_digest


@dataclass(frozen=True)
class NamedSchedule:
    """A query schedule by its name, or its class as ``"module:Class"``."""

    source: str

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords that an environment needs for it: none, schedules speak every encoding."""
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
        identity: Digest that tells policies apart whatever their files are called.
    """

    source: str
    identity: str
    card: Mapping[str, Any]

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords that an environment needs for it: its action encoding."""
        return {"action": self.action}

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

        present, known = (card["sha256"] for card in (read_policy(self.source).card, self.card))
        if present != known:
            raise ValueError(f"{self.source!r} has changed: sha256 {present}, it was {known}")
        policy: Policy = load_policy(self.source, env, allow=allow)
        return policy


@dataclass(frozen=True)
class SavedModel:
    """A model as stable-baselines3 and sb3-contrib save it.

    Loading one unpickles it, which can run any code: load files that you trust.

    Attributes:
        source: ``"module:Class=file.zip"``, such as ``"stable_baselines3:PPO=ppo.zip"``.
    """

    source: str

    def __reduce__(self) -> tuple[type[SavedModel], tuple[str]]:
        """Go to other processes without the model, which not every library can pickle."""
        return SavedModel, (self.source,)

    @property
    def path(self) -> str:
        """The file."""
        return self.source.partition("=")[2]

    @cached_property
    def model(self) -> Any:
        """The model.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: There is no such class, or it cannot load the file.
        """
        if not Path(self.path).is_file():
            raise FileNotFoundError(f"there is no saved model {self.path!r}")
        name = self.source.partition("=")[0].partition(":")[2]
        module = _imported(self.source)
        try:
            return getattr(module, name).load(self.path, device="cpu")
        except Exception as problem:
            raise ValueError(
                f"{self.source!r} cannot be loaded: {type(problem).__name__}: {problem}"
            ) from problem

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords that an environment needs for it: the encoding of its action space.

        Raises:
            ValueError: It cannot be loaded, or no encoding has such a space.
        """
        kind = type(self.model.action_space)
        if kind not in _ENCODINGS:
            raise ValueError(
                f"{self.source!r} has actions of {kind.__name__}, which no encoding has"
            )
        return {"action": _ENCODINGS[kind]}

    @property
    def identity(self) -> str:
        """Digest of the file."""
        return file_digest(self.path)

    def load(self, env: Any, *, allow: Collection[str] = (), seed: int | None = None) -> Policy:
        """Bind the model to an environment.

        Raises:
            ValueError: Its spaces are not those of the environment.
        """
        del allow, seed  # spaces must be equal, whatever may differ; models hold their own seed
        bare, model = env.unwrapped, self.model
        for name in ("observation_space", "action_space"):
            given, own = getattr(bare, f"single_{name}", getattr(bare, name)), getattr(model, name)
            if given.shape != own.shape or given.dtype != own.dtype or _size(given) != _size(own):
                raise ValueError(
                    f"{self.source!r} has the {name} {own}, the environment has {given}"
                )
        policy: Policy = model
        takes_masks = "action_masks" in inspect.signature(model.predict).parameters
        if takes_masks and self.keywords["action"] == "sequential":

            def predict(*given: Any, **more: Any) -> Any:
                return model.predict(*given, **more, action_masks=bare.action_masks())

            policy = SimpleNamespace(predict=predict)
        return policy


_ENCODINGS = {
    spaces.MultiBinary: "mask",
    spaces.Box: "scores",
    spaces.MultiDiscrete: "slots",
    spaces.Discrete: "sequential",
}
"""Action encoding by the type of its space."""


def _size(space: Any) -> Any:
    """Return the number of choices of a discrete space."""
    return getattr(space, "n", None) if not hasattr(space, "nvec") else space.nvec.tolist()


PolicySource = NamedSchedule | SavedPolicy | SavedModel
"""A query policy before it is bound to an environment."""


_ENDINGS = (SUFFIX, ".zip")
"""Endings of the files of policies; libraries save theirs as .zip."""


def policy_name(source: str) -> str:
    """Return the name of a policy in tables.

    Files of trainings have one name; their folders differ.
    """
    path = Path(source.partition("=")[2] or source)
    return f"{path.parent.name}/{path.stem}" if path.suffix in _ENDINGS else source


def find_policy(source: str) -> PolicySource:
    """Return the policy that a name or a file stands for.

    Args:
        source: The ``.safetensors`` file of a saved policy, the name of one that comes with the
            package, a model of stable-baselines3 as ``"module:Class=file.zip"``, or else a
            schedule: its name or ``"module:Class"``. Whether a schedule or a model exists and suits
            an environment is checked when it is loaded.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: The file is not a saved policy.
    """
    if ":" in source.partition("=")[0] and "=" in source:
        return SavedModel(source)
    if source.endswith(_ENDINGS) or source in shipped_policies():
        return read_saved_policy(source)
    return NamedSchedule(source)


def read_saved_policy(source: str | Path) -> SavedPolicy:
    """Read the card of a saved policy.

    Raises:
        FileNotFoundError: There is no such file, nor such a name.
        ValueError: The file is not a saved policy.
    """
    file = read_policy(source)
    saved = SavedPolicy(file.source, file.identity, file.card)
    try:
        # The entries of the card that the properties rely on must be there.
        _ = saved.recipe, saved.training_seed
    except (KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{file.source!r} is not a saved policy: {problem!r}") from problem
    return saved
