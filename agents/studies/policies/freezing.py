"""From policies to a manifest: what suits, what validation traffic says, what is chosen."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.provenance import provenance
from agents.studies.policies.manifest import Checkpoint, Choice, Manifest, Tuned
from agents.studies.policies.plan import Cell, Design, Entry
from agents.studies.policies.running import config_of, make_task, mean_error, suited

TEST, VALIDATION, ASKED = "episodes.csv", "validation.csv", "asked.csv"


def plain(design: Design) -> dict[str, Any]:
    """Return a design as plain JSON."""
    content: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(design)))
    return content


def design_of(content: Mapping[str, Any]) -> Design:
    """Return the design that `plain` made JSON of.

    Raises:
        ValueError: A value is out of range.
    """
    cells = [
        Cell(**{**own, **{key: tuple(own[key]) for key in ("transfers", "bounds", "without")}})
        for own in content["cells"]
    ]
    others = {key: tuple(value) for key, value in content.items() if key != "cells"}
    return Design(cells=tuple(cells), **others)


@dataclasses.dataclass(frozen=True)
class _OneCell:
    """A design of one cell, as `agents.experiments.provenance.provenance` takes it."""

    cell: Cell
    seeds: tuple[int, ...]
    schedule: str = "every baseline"

    @property
    def env(self) -> str:
        return self.cell.env

    def cells(self) -> list[Cell]:
        return [self.cell]


def origin_of(design: Design) -> dict[str, Any]:
    """Return what the results depend on beside policies and seeds, for `take_folder`.

    Raises:
        ValueError: A cell is out of range; the message names the value.
    """
    parts = {cell.name: provenance(_OneCell(cell, design.test_seeds)) for cell in design.cells}
    settings: dict[str, Any] = {}
    for part in parts.values():
        settings |= part["made_with"].pop("settings")
    first = next(iter(parts.values()))
    return {
        **first,
        "made_with": {
            "cells": {name: part["made_with"] for name, part in parts.items()},
            "settings": settings,
        },
        "tuned": sorted({name for part in parts.values() for name in part["tuned"]}),
    }


def draft(
    design: Design, checkpoints: Sequence[Checkpoint], tuned: Sequence[Tuned], command: str
) -> Manifest:
    """Return a manifest without choices, after trying everyone in every cell.

    Raises:
        ValueError: A policy does not fit its cell, settings fit no cell or belong to nobody, a
            bound does not suit its cell, or a cell has no baseline.
    """
    fits = {
        cell.name: suited(
            cell, [name for name in (*design.baselines, *cell.bounds) if name not in cell.without]
        )
        for cell in design.cells
    }
    ladder = {
        name: tuple(own for own in fit if own in design.baselines)
        for name, (fit, _) in fits.items()
    }
    bounds = {
        cell.name: tuple(own for own in fits[cell.name][0] if own in cell.bounds)
        for cell in design.cells
    }
    unsuited = {
        cell.name: fits[cell.name][1]
        | {name: "left out for its cost" for name in cell.without if name in design.baselines}
        for cell in design.cells
    }
    unsuited = {name: others for name, others in unsuited.items() if others}
    manifest = Manifest(
        design=plain(design),
        command=command,
        checkpoints=tuple(checkpoints),
        tuned=tuple(tuned),
        ladder=ladder,
        bounds=bounds,
        unsuited=unsuited,
    )
    _check_tuned(design, manifest)
    for entry in manifest.entries(design, bounds=False):
        if entry.kind == "learned":
            task = make_task(entry, design, manifest, seeds=(0,), noise=0)
            task.make()
    return manifest


def _check_tuned(design: Design, manifest: Manifest) -> None:
    """Refuse settings that nobody would use: a wrong name would otherwise go unnoticed."""
    names = {*design.baselines, *(own.recipe for own in manifest.checkpoints)}
    names |= {name for cell in design.cells for name in cell.bounds}
    for own in manifest.tuned:
        if own.policy not in names:
            raise ValueError(f"settings are given for {own.policy!r}, which is not run")
        configs = [config_of(cell, (0,)) for cell in design.cells]
        if all(manifest.settings(own.policy, config) is None for config in configs):
            raise ValueError(
                f"settings of {own.policy!r} are for {own.estimator}, {own.parameters}, "
                f"{own.privacy}: no cell is that"
            )


def check_untouched(folder: Path) -> None:
    """Refuse a folder in which test traffic was run.

    Raises:
        ValueError: It was.
    """
    if (folder / TEST).exists():
        raise ValueError(
            f"{folder / TEST} exists: test traffic has been run, nothing can be frozen any more. "
            "Choose another --output"
        )


def begin(folder: Path, own: Manifest) -> Manifest:
    """Put a draft into a folder, or go on with the same one there.

    Raises:
        ValueError: The folder has a manifest of something else.
    """
    try:
        before = Manifest.read(folder)
    except FileNotFoundError:
        own.write(folder)
        return own
    kept = dataclasses.replace(before, choices={}, frozen="", command=own.command)
    if kept.digest != own.digest:
        raise ValueError(
            f"{folder} has a manifest of other policies, cells or settings: choose another "
            "--output, or remove the folder to start over"
        )
    return before


def choose(design: Design, manifest: Manifest, ledger: Ledger[Entry, EpisodeScore]) -> Manifest:
    """Return the manifest with what validation traffic decides, frozen.

    Args:
        design: What is run.
        manifest: The draft.
        ledger: Scores on validation traffic of all its entries without bounds.
    """
    choices = {cell.name: _choice(cell, design, manifest, ledger) for cell in design.cells}
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return dataclasses.replace(manifest, choices=choices, frozen=now)


def _choice(
    cell: Cell, design: Design, manifest: Manifest, ledger: Ledger[Entry, EpisodeScore]
) -> Choice:
    seeds = design.validation_seeds
    baselines = {
        name: mean_error(ledger, Entry(cell.name, "baseline", name), seeds)
        for name in manifest.ladder[cell.name]
    }
    learners = {}
    for learner in manifest.learners(cell):
        runs = [learner.entry(seed) for seed in manifest.runs(learner)]
        errors = [mean_error(ledger, entry, seeds) for entry in runs]
        learners[learner.policy, learner.mode] = sum(errors) / len(errors)
    best = {cell.name: min(learners, key=lambda pair: learners[pair])} if learners else {}
    named = {f"{policy}, {mode}": error for (policy, mode), error in learners.items()}
    return Choice(
        baseline=min(baselines, key=lambda name: baselines[name]),
        learners=best,
        errors={**baselines, **named},
    )
