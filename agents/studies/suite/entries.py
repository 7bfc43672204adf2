"""Entries to the query suite: who plays, the card of it, and the check of a card.

The folder of an entry is that of a study, with its rows; a card beside them says what rows do not.
"""

from __future__ import annotations

import dataclasses
import random
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from agents.environments import parse_env
from agents.files import write_json
from agents.play import Cell, play
from agents.policies import find_policy, policy_name
from agents.studies.suite.access import Access, access_of
from agents.studies.suite.scores import errors_of
from agents.studies.suite.tasks import NAME, ROUND_ROBIN, TASKS, make_cell, references
from agents.study import ROWS, read_rows
from agents.tables import ERROR, are_present, values_of
from dptse_env.config import TEST_SEEDS
from dptse_env.policies import SUFFIX, read_policy, shipped_policies
from dptse_env.traffic import Records
from dptse_env.utils.files import write_atomically
from dptse_env.utils.validation import integer, positive, read_json, read_toml, require
from dptse_env.versions import code_version

CARD = "card.json"
"""File of an entry's card in its folder."""

OTHERS = "others"
"""Name in a table of policies of what acts in the tasks that it leaves out."""

MILLION = 1_000_000
"""Seconds of traffic of a training in the smaller track."""

FRESH_SEEDS = range(10_000, 1_000_000)
"""Traffic seeds that may be drawn; no training or study of ours has them."""

TOLERANCE, ON_AVERAGE = 0.02, 0.002
"""Shares by which an error may differ when it is played again, and errors on average: on another
processor the last bits of an estimate are others, and now and then a choice with them."""


@dataclass(frozen=True)
class Entry:
    """An entry, as its card has it.

    Attributes:
        name: Its name in tables.
        policies: What `find_policy` takes, by task, for each training seed or once.
        left: Why the round robin acts in some tasks, by task.
        steps: Seconds of traffic of one training, all its files together; None if not known.
        minutes: Processor minutes of one training; None if not said.
        parameters: Numbers that are trained in one training; None if not known.
        tuning: What was tried before, in words.
        reads: What the policies read.
        fresh: Traffic seeds that were drawn for it; None for those of the tasks.
    """

    name: str
    policies: Mapping[str, Sequence[str]]
    left: Mapping[str, str]
    steps: int | None
    minutes: float | None
    parameters: int | None
    tuning: str
    reads: Access = "observations"
    fresh: Sequence[int] | None = None

    @property
    def track(self) -> str:
        """The track in which it competes."""
        return "1 million" if self.steps is not None and self.steps <= MILLION else "unlimited"

    @property
    def training_seeds(self) -> int:
        """Number of trainings."""
        return max(map(len, self.policies.values()))

    def cells_of(self, task: str, *policies: str) -> list[Cell]:
        """Return its policies in a task, or others on the same traffic."""
        seeds = None if self.fresh is None else tuple(self.fresh)
        return [make_cell(task, each, seeds=seeds) for each in policies or self.policies[task]]

    def cells(self, rules: Mapping[str, str]) -> list[Cell]:
        """Return what is played for it: on fresh traffic the schedules of tables, too.

        Args:
            rules: The rule of each task.
        """
        cells = [cell for task in self.policies for cell in self.cells_of(task)]
        if self.fresh is not None:
            for task in self.policies:
                cells += self.cells_of(task, *references(rules[task]))
        return cells


def make_entry(policies: Sequence[str], tasks: Sequence[str]) -> Entry:
    """Return the entry of policies, or of the one TOML file that describes it.

    The key ``policies`` of a file is a policy, a list with one for each training seed, or a table
    of these by task, in which ``others`` stands for the tasks that are not named (the round robin
    if absent). Paths are relative to the file. ``name``, ``minutes`` and ``tuning`` are told in
    tables. ``steps`` and ``parameters`` are read in the files of policies; classes have none, so
    that their author says both here.

    Args:
        policies: A policy for each training seed, or the file.
        tasks: The tasks in which it plays.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: A policy was trained on test traffic or on a held-out road, does not suit the
            task that a table names it for, or suits no task at all.
    """
    path, told = "policies", dict[str, Any]()
    several = f"-x{len(policies)}" if len(policies) > 1 else ""
    name, table = f"{policy_name(policies[0])}{several}", {OTHERS: list(policies)}
    if len(policies) == 1 and policies[0].endswith(".toml"):
        path, file = policies[0], Path(policies[0])
        told = read_toml(file, "entry")
        known = ["minutes", "name", "parameters", "policies", "steps", "tuning"]
        unknown = sorted(told.keys() - set(known))
        require(not unknown, path, f"an entry with keys {known}", unknown)
        name, table = str(told.get("name", file.stem)), _table(told.get("policies"), file)
    numbers = {len(each) for each in table.values()} - {1}
    require(len(numbers) <= 1, path, "as many policies for each task, or one", sorted(numbers))
    for sources in table.values():
        require(len({*sources}) == len(sources), path, "different policies", sources)
        for source in sources:
            require_fair(source)
    found, left = dict[str, list[str]](), dict[str, str]()
    for task in tasks:
        found[task] = table.get(task, table.get(OTHERS, [ROUND_ROBIN]))
        misfits = [make_cell(task, source).misfit() for source in found[task]]
        problem = next(filter(None, misfits), None)
        if problem is not None:
            require(task not in table, f"{path}: {task}", f"what suits it: {problem}", found[task])
            found[task], left[task] = [ROUND_ROBIN], problem
    if len(left) == len(tasks):
        raise ValueError(f"{name!r} acts in no task: {next(iter(left.values()))}")
    trainings = [
        _trained({own[k % len(own)] for own in found.values()}) for k in range(max([*numbers, 1]))
    ]
    counts: dict[str, int | None] = {}
    for key, read in zip(("steps", "parameters"), zip(*trainings, strict=True), strict=True):
        sure = [each for each in read if each is not None]
        counts[key] = max(sure) if len(sure) == len(read) else None
        if key in told:
            require(counts[key] is None, f"{path}: {key}", "left out, as files say it", told[key])
            counts[key] = integer(f"{path}: {key}", told[key], 0)
    return Entry(
        name=name,
        policies=found,
        left=left,
        steps=counts["steps"],
        minutes=positive(f"{path}: minutes", told["minutes"]) if "minutes" in told else None,
        parameters=counts["parameters"],
        tuning=str(told.get("tuning", "not said")),
    )


def _table(given: Any, file: Path) -> dict[str, list[str]]:
    """Return policies by task, as the file of an entry has them."""
    table = {}
    for task, value in (given if isinstance(given, dict) else {OTHERS: given}).items():
        allowed = [*TASKS, OTHERS]
        require(task in allowed, f"{file}: policies", f"a table of {allowed}", task)
        sources: list[Any] = value if isinstance(value, list) and value else [value]
        named = all(isinstance(each, str) for each in sources)
        require(named, f"{file}: policies.{task}", "policies, one or for each seed", value)
        table[task] = [_resolved(each, file.parent) for each in sources]
    return table


def _resolved(source: str, folder: Path) -> str:
    is_file = source.endswith(SUFFIX) and source not in shipped_policies()
    return str(folder / source) if is_file else source


def _trained(sources: Iterable[str]) -> tuple[int | None, int | None]:
    """Return seconds of traffic and weights of a training's files, None where a class has some."""
    steps: int | None = 0
    weights: int | None = 0
    own: int | None
    trained: int | None
    for source in sources:
        card = find_policy(source).card
        if card is not None:
            own = card["training"].get("steps")
            trained = sum(array.size for array in read_policy(source).weights.values())
        else:
            own = trained = None if ":" in source else 0
        steps = None if own is None or steps is None else steps + int(own)
        weights = None if trained is None or weights is None else weights + trained
    return steps, weights


# What an entry may not be.


def seeds_of(card: Mapping[str, Any]) -> list[range]:
    """Return the traffic seeds that a policy was trained and chosen on; none if not said."""
    told = (str(card["training"].get(f"{kind} seeds", "")) for kind in ("traffic", "validation"))
    pairs = re.findall(r"(\d+)(?:\.\.(\d+))?", ", ".join(told))
    return [range(int(first), int(last or first) + 1) for first, last in pairs]


def require_fair(source: str) -> None:
    """Refuse a saved policy that was trained on test traffic, or on a held-out road.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It was.
    """
    card = find_policy(source).card
    if card is None:
        return
    said = f"{source!r} cannot enter the suite: its file says that it was trained"
    tests = {*TEST_SEEDS, *(seed for task in TASKS.values() for seed in task.seeds)}
    leaked = sorted(seed for own in seeds_of(card) for seed in tests.intersection(own))
    if leaked:
        raise ValueError(f"{said} or chosen on test traffic, seed {leaked[0]}")
    others = (parse_env(each) for each in card["training"].get("also", ()))
    roads = {Cell(env, keywords=given).config.corridor.digest for env, given in others}
    for name in (name for name, task in TASKS.items() if task.is_held_out):
        if make_cell(name, ROUND_ROBIN).config.corridor.digest in {
            *roads,
            card["fits"]["corridor"],
        }:
            raise ValueError(f"{said} on the road of {name!r}, which is held out")


# What is played for an entry, and kept.


def begin(entry: Entry, folder: Path, fresh: int | None, records: Records = None) -> Entry:
    """Return an entry with what it reads and maybe fresh seeds; write its card and files.

    An entry that was begun on fresh traffic goes on with the seeds of its card.

    Args:
        entry: From `make_entry`.
        folder: The folder of its results.
        fresh: Number of traffic seeds that are drawn; None to play those of the tasks.
        records: Folder of the record cache; None for the user's cache.

    Raises:
        ValueError: The folder has something that is no card, or the card of an entry on other
            traffic, or of other policies on fresh traffic.
    """
    first = {source: task for task, own in entry.policies.items() for source in own}
    names = {source: _name_there(source) for source in first}
    told = {task: [names[each] for each in own] for task, own in entry.policies.items()}
    drawn = None if fresh is None else sorted(random.SystemRandom().sample(FRESH_SEEDS, fresh))
    if (folder / CARD).exists():
        kept = read_entry(folder / CARD)
        fits = (None if kept.fresh is None else len(kept.fresh)) == fresh
        if fits and fresh is not None:
            fits, drawn = kept.policies == _table(told, folder / CARD), list(kept.fresh or ())
        require(fits, "output", "a folder of this entry, or a new one", str(folder))
    reads = {access_of(make_cell(task, source), records) for source, task in first.items()}
    order: tuple[Access, ...] = ("truth", "process", "observations")
    entry = dataclasses.replace(
        entry, reads=next(each for each in order if each in reads), fresh=drawn
    )
    about = {"suite": NAME, "package": code_version(), "track": entry.track}
    folder.mkdir(parents=True, exist_ok=True)
    # The card is the first file, by which an interrupted entry is known.
    write_json(folder / CARD, about | dataclasses.asdict(entry) | {"policies": told})
    for source, name in names.items():
        target = folder / name
        if name != source and not target.exists():
            target.parent.mkdir(exist_ok=True)
            write_atomically(target, Path(source).read_bytes())
    return entry


def _name_there(source: str) -> str:
    """Return what a policy is called in the folder of an entry, which has a copy of its file."""
    if source.endswith(SUFFIX) and source not in shipped_policies():
        return f"policies/{find_policy(source).identity[:16]}{SUFFIX}"
    return source


def read_entry(path: Path) -> Entry:
    """Read the card of an entry.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no card, or one of another suite.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there")
    content, names = read_json(path), {each.name for each in dataclasses.fields(Entry)}
    fits = isinstance(content, dict) and content.keys() == {*names, "suite", "package", "track"}
    require(fits, str(path), "a card that 'dptse evaluate --suite' wrote", content)
    require(content["suite"] == NAME, f"{path}: suite", NAME, content["suite"])
    table, fresh = _table(content["policies"], path), content["fresh"]
    require(table.keys() <= TASKS.keys(), f"{path}: policies", "by task", content["policies"])
    fits = fresh is None or (isinstance(fresh, list) and all(each in FRESH_SEEDS for each in fresh))
    require(fits, f"{path}: fresh", "drawn traffic seeds", fresh)
    return Entry(**{name: content[name] for name in names} | {"policies": table})


def check(path: Path, number: int, records: Records = None) -> float:
    """Play rows of an entry again, and return the largest deviation as a share.

    It is all traffic of training seeds that are drawn at this call: a policy that draws its actions
    does so for a whole batch.

    Args:
        path: Its card, beside which its rows and policies are.
        number: Training seeds that are drawn in each task.
        records: Folder of the record cache; None for the user's cache.

    Raises:
        FileNotFoundError: A policy is not there.
        ValueError: Rows differ from what is played.
        UnmeasuredError: There are none of these policies with these numbers.
    """
    entry, rows = read_entry(path), read_rows("suite", path.parent)
    rows = rows.filter(are_present(rows))
    draw = random.SystemRandom()
    largest = 0.0
    for task in entry.policies:
        cells = entry.cells_of(task)
        for cell in draw.sample(cells, min(number, len(cells))):
            require_fair(cell.policy)
            told, seeds = errors_of(rows, cell)[0], cell.seeds or ()
            found = values_of(pl.DataFrame(play(cell, seeds, records)), ERROR)
            off = np.abs(told / found - 1.0)
            if off.max() > TOLERANCE or off.mean() > ON_AVERAGE:
                raise ValueError(
                    f"{path.parent / ROWS}: errors of {cell.policy!r} in {task!r} must be as they "
                    f"are when they are played again, but for {TOLERANCE:.0%} and {ON_AVERAGE:.1%} "
                    f"on average, got {told[off.argmax()]:.4f} for {found[off.argmax()]:.4f} on "
                    f"traffic seed {seeds[off.argmax()]}, and {off.mean():.2%}"
                )
            largest = max(largest, float(off.max()))
    return largest
