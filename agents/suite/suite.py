"""A suite from policies to their cards."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

from agents.engines.engine import run_shown
from agents.experiments.provenance import machine, source_digest
from agents.experiments.runner import Workplace
from agents.policies import PolicySource, find_policy
from agents.suite.card import DONE, Card, CellResult
from agents.suite.cells import Suite, SuiteCell
from agents.suite.running import SuiteTask, run_cell


def card_name(source: str) -> str:
    """Return the name of a policy in tables, and of its card's file without the suffix.

    Files of runs have one name; their folders differ.
    """
    path = Path(source.partition("=")[2] or source)
    name = f"{path.parent.name}-{path.stem}" if path.suffix in (".zip", ".json") else source
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-.")


def run_suite(
    suite: Suite, sources: Sequence[str], place: Workplace, progress: bool = True
) -> list[Card]:
    """Run policies in the cells that their cards lack, and leave a card for each in a folder.

    A card is written after each cell, so an interrupted run goes on where it stopped. A cell in
    which a policy failed is tried again.

    Returns:
        The cards, in the order of the policies.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: A file is no saved policy, a card in the folder is of another policy or suite or
            was begun with other versions, or two policies would have one card.
    """
    policies = [find_policy(source) for source in sources]
    names = [card_name(source) for source in sources]
    for policy in policies:
        _ = policy.keywords  # a model that cannot be loaded shows before anything is recorded
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"policies must have different names, {twice[0]!r} is there twice")
    cards = {
        name: _started(suite, name, policy, place.folder)
        for name, policy in zip(names, policies, strict=True)
    }
    tasks = [
        SuiteTask(policy, cell, place.records)
        for name, policy in zip(names, policies, strict=True)
        for cell in suite.cells
        if not _is_done(cards[name], cell)
    ]
    tasks.sort(key=lambda task: _size(task.cell), reverse=True)  # no worker ends with a long one
    _record(tasks, place)
    place.folder.mkdir(parents=True, exist_ok=True)

    def take(task: SuiteTask, result: CellResult) -> None:
        name = card_name(task.policy.source)
        cards[name] = _with(cards[name], result, suite)
        cards[name].write(place.folder / f"{name}.json")

    run_shown(place.engine, run_cell, tasks, take, progress=progress, desc=suite.name, unit="cell")
    return [cards[name] for name in names]


def _started(suite: Suite, name: str, policy: PolicySource, folder: Path) -> Card:
    """Return the card that a folder has of a policy, or an empty one."""
    made_with = machine(("dptse-env", "gymnasium", "libsumo", "numba", "numpy", "scipy"))
    made_with["source"] = source_digest()
    new = Card(suite.name, name, policy.source, policy.identity, made_with)
    path = folder / f"{name}.json"
    if not path.exists():
        return new
    found = Card.read(path)
    found.check(suite, path)
    if found.identity != new.identity:
        raise ValueError(
            f"{path} is the card of another policy of this name, {found.source!r}: choose another "
            "--output, or remove the card"
        )
    begun = {key: value for key, value in found.made_with.items() if made_with.get(key) != value}
    if begun and not all(_is_done(found, cell) for cell in suite.cells):
        raise ValueError(
            f"{path} was begun with other versions ({', '.join(begun)}): choose another --output, "
            "or remove the card"
        )
    return found


def _size(cell: SuiteCell) -> int:
    """Return the segments that a policy estimates in a cell, all seconds and episodes together."""
    config = cell.config
    return config.corridor.n_mainline * config.horizon_steps * len(cell.traffic_seeds)


def _is_done(card: Card, cell: SuiteCell) -> bool:
    result = card.results.get(cell.name)
    return result is not None and result.status == DONE


def _with(card: Card, result: CellResult, suite: Suite) -> Card:
    """Return a card with one more result, in the order of the cells."""
    known = {**card.results, result.cell: result}
    ordered = {cell.name: known[cell.name] for cell in suite.cells if cell.name in known}
    return dataclasses.replace(card, results=ordered)


def _record(tasks: Sequence[SuiteTask], place: Workplace) -> None:
    """Record the traffic that is missing, of each road once."""
    seeds_of = {task.cell.config.corridor: task.cell.traffic_seeds for task in tasks}
    for corridor, seeds in seeds_of.items():
        place.record(corridor, seeds)
