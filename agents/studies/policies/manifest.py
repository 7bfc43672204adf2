"""The manifest: the policies and choices that are fixed before test traffic is touched."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.files import write_json
from agents.policies import SavedPolicy, read_saved_policy
from agents.studies.policies.plan import MODES, Entry, Learner, PolicyCell, PolicyDesign
from dptse_env.config import EnvConfig
from dptse_env.estimators.tuned_settings import read_settings
from dptse_env.utils.digests import json_digest

MANIFEST_FILE = "manifest.json"


@dataclass(frozen=True)
class Checkpoint:
    """A saved policy that was frozen.

    Attributes:
        cell: Cell that it was trained for.
        recipe: Recipe that trained it, or the name that it was given.
    """

    cell: str
    recipe: str
    training_seed: int
    action: str
    path: str
    sha256: str

    def saved(self) -> SavedPolicy:
        """Return the saved policy.

        Raises:
            FileNotFoundError: It is gone.
            ValueError: It is not the file that was frozen.
        """
        saved = read_saved_policy(self.path)
        if saved.sha256 != self.sha256:
            raise ValueError(
                f"{self.path} is not the policy that was frozen: its sha256 is {saved.sha256}, the "
                f"manifest has {self.sha256}"
            )
        return saved


@dataclass(frozen=True)
class Tuned:
    """Estimator settings that were tuned for one policy, as ``scripts/tune.py`` writes them.

    Attributes:
        policy: The schedule or recipe that uses them.
        settings: Fields of `EstimatorSettings`.
    """

    policy: str
    estimator: str
    parameters: str
    privacy: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class CellChoice:
    """The choices in a cell that validation traffic decided.

    Attributes:
        baseline: The schedule of least error.
        learners: By the cell that a policy was trained for, the recipe and the mode of least error.
        errors: Mean error by policy and mode.
    """

    baseline: str
    learners: dict[str, tuple[str, str]]
    errors: dict[str, float]


@dataclass(frozen=True)
class Manifest:
    """The policies and choices that are fixed before test traffic is touched.

    Attributes:
        design: The design, as plain JSON.
        command: The command that froze it.
        checkpoints: The policies.
        tuned: Estimator settings that were tuned for single policies.
        ladder: By cell, the baselines that suit it.
        bounds: By cell, the oracles that suit it.
        unsuited: By cell, the reasons why other baselines and oracles do not.
        choices: By cell; empty until validation is done.
        frozen: Time of freezing, in UTC; empty until then.
    """

    design: dict[str, Any]
    command: str
    checkpoints: tuple[Checkpoint, ...]
    tuned: tuple[Tuned, ...]
    ladder: dict[str, tuple[str, ...]]
    bounds: dict[str, tuple[str, ...]]
    unsuited: dict[str, dict[str, str]]
    choices: dict[str, CellChoice] = dataclasses.field(default_factory=dict)
    frozen: str = ""

    def write(self, folder: Path) -> None:
        """Write the manifest to a folder in one piece."""
        write_json(folder / MANIFEST_FILE, dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read the manifest of a folder.

        Raises:
            FileNotFoundError: Nothing was frozen there.
            ValueError: It is not as this class writes it.
        """
        path = folder / MANIFEST_FILE
        if not path.exists():
            raise FileNotFoundError(
                f"{path} is missing: freeze policies first, with `study.py policies freeze`"
            )
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            choices = {
                cell: CellChoice(
                    choice["baseline"],
                    {origin: (pair[0], pair[1]) for origin, pair in choice["learners"].items()},
                    choice["errors"],
                )
                for cell, choice in content.pop("choices").items()
            }
            return cls(
                checkpoints=tuple(Checkpoint(**fields) for fields in content.pop("checkpoints")),
                tuned=tuple(Tuned(**fields) for fields in content.pop("tuned")),
                ladder={cell: tuple(names) for cell, names in content.pop("ladder").items()},
                bounds={cell: tuple(names) for cell, names in content.pop("bounds").items()},
                choices=choices,
                **content,
            )
        except (json.JSONDecodeError, KeyError, TypeError) as problem:
            raise ValueError(f"{path} is not as this program writes it: {problem!r}") from problem

    @property
    def digest(self) -> str:
        """Digest of the manifest."""
        return json_digest(dataclasses.asdict(self))[:12]

    def checkpoint(self, entry: Entry) -> Checkpoint:
        """Return the policy behind an entry of kind ``learned``.

        Raises:
            ValueError: It was not frozen.
        """
        wanted = entry.trained_in, entry.policy, entry.training_seed
        for checkpoint in self.checkpoints:
            if (checkpoint.cell, checkpoint.recipe, checkpoint.training_seed) == wanted:
                return checkpoint
        raise ValueError(f"the manifest has no policy {wanted}")

    def settings(self, policy: str, config: EnvConfig) -> dict[str, Any] | None:
        """Return the settings tuned for a policy in a configuration, None if none."""
        place = config.estimator, str(config.parameters), config.privacy.preset
        for tuned in self.tuned:
            if (tuned.policy, tuned.estimator, tuned.parameters, tuned.privacy) == (policy, *place):
                return tuned.settings
        return None

    def learners(self, cell: PolicyCell) -> list[Learner]:
        """Return the learned policies that are run in a cell.

        These are the recipes trained for it, in both modes, and transfers: of each other cell the
        recipe and mode that its validation chose.
        """
        trained = (each for each in self.checkpoints if each.cell == cell.name)
        recipes = dict.fromkeys(checkpoint.recipe for checkpoint in trained)
        found = [Learner(cell.name, name, cell.name, mode) for name in recipes for mode in MODES]
        for origin in cell.transfers:
            if origin in self.choices and origin in self.choices[origin].learners:
                recipe, mode = self.choices[origin].learners[origin]
                found.append(Learner(cell.name, recipe, origin, mode))
        return found

    def runs(self, learner: Learner) -> tuple[int, ...]:
        """Return the training seeds of a learner, ascending."""
        trained = (learner.trained_in, learner.policy)
        found = (each for each in self.checkpoints if (each.cell, each.recipe) == trained)
        return tuple(sorted(each.training_seed for each in found))

    def entries(self, design: PolicyDesign, bounds: bool = True) -> list[Entry]:
        """Return all policies that are run, in every cell, with or without oracles."""
        entries = []
        for cell in design.cells:
            entries += [Entry(cell.name, "baseline", name) for name in self.ladder[cell.name]]
            if bounds:
                entries += [Entry(cell.name, "bound", name) for name in self.bounds[cell.name]]
            for learner in self.learners(cell):
                entries += [learner.entry(seed) for seed in self.runs(learner)]
        return entries


def find_checkpoints(
    given: Sequence[str], design: PolicyDesign, which: str = "best.zip"
) -> tuple[Checkpoint, ...]:
    """Return the policies that were named, in order.

    Args:
        given: ``cell=path`` or ``cell:name=path``; a path is a saved policy, a run folder, or a
            folder of those. A name tells policies of one recipe with other arguments apart.
        design: The design, whose cells may be named.
        which: The file to take from a run folder.

    Raises:
        FileNotFoundError: A path leads to no saved policy.
        ValueError: A cell is unknown, a file is no saved policy, or two are of one training seed.
    """
    found: dict[tuple[str, str, int], Checkpoint] = {}
    for text in given:
        place, equals, path = text.partition("=")
        if not equals:
            raise ValueError(f"policies must be cell=path, got {text!r}")
        cell_name, _, name = place.partition(":")
        cell = design.cell(cell_name)
        for file in _files(Path(path), which):
            saved = read_saved_policy(file)
            key = cell.name, name or saved.recipe, saved.training_seed
            if key in found:
                raise ValueError(
                    f"{file} and {found[key].path} are both {key[1]} of training seed {key[2]} "
                    f"for cell {cell.name!r}; cell:name=path tells them apart"
                )
            found[key] = Checkpoint(*key, saved.action, file.as_posix(), saved.sha256)
    return tuple(found.values())


def _files(path: Path, which: str) -> list[Path]:
    if path.is_file():
        return [path]
    found = [path / which] if (path / which).is_file() else sorted(path.glob(f"*/{which}"))
    if not found:
        raise FileNotFoundError(f"there is no {which} in {path} nor one folder below it")
    return found


def read_tuned(given: Iterable[str]) -> tuple[Tuned, ...]:
    """Return settings tuned for single policies, given as ``policy=file``.

    Raises:
        ValueError: A file is not as ``scripts/tune.py`` writes it, or two are for one place.
    """
    found: dict[tuple[str, ...], Tuned] = {}
    for text in given:
        policy, equals, path = text.partition("=")
        if not equals:
            raise ValueError(f"settings must be policy=file, got {text!r}")
        settings = dataclasses.asdict(read_settings(path))  # checks the rest of the file, too
        content: Mapping[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
        place = (policy, content["estimator"], content["parameters"], content["privacy"])
        if place in found:
            raise ValueError(f"settings of {', '.join(place)} are given twice")
        found[place] = Tuned(*place, settings)
    return tuple(found.values())
