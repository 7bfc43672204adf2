"""Freezing: which schedules suit a cell, and the choices that validation traffic makes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.provenance import environment_provenance, results_provenance
from agents.studies.policies.manifest import CellChoice, Checkpoint, Manifest, Tuned
from agents.studies.policies.plan import Entry, PolicyCell, PolicyDesign
from agents.studies.policies.running import cell_config, make_task, suitable

TEST, VALIDATION, QUERIES = "episodes.csv", "validation.csv", "queries.csv"


def design_provenance(design: PolicyDesign) -> dict[str, Any]:
    """Return the provenance of the results of a design but for policies and seeds.

    Raises:
        ValueError: A cell is out of range; the message names the value.
    """
    configs = {cell.name: cell_config(cell, design.test_seeds) for cell in design.cells}
    cells = {
        cell.name: environment_provenance(cell.env, "every baseline", [configs[cell.name]])
        for cell in design.cells
    }
    return results_provenance({"cells": cells}, list(configs.values()))


def draft(
    design: PolicyDesign, checkpoints: Sequence[Checkpoint], tuned: Sequence[Tuned], command: str
) -> Manifest:
    """Return a manifest without choices, after trying every policy in every cell.

    Raises:
        ValueError: A policy does not fit its cell, settings fit no cell or no policy, a bound does
            not suit its cell, or a cell has no baseline.
    """
    ladder, bounds, unsuited = {}, {}, {}
    for cell in design.cells:
        tried = (*design.baselines, *cell.bounds)
        fit, reasons = suitable(cell, [name for name in tried if name not in cell.without])
        reasons |= {n: "left out for its cost" for n in cell.without if n in design.baselines}
        ladder[cell.name] = tuple(name for name in fit if name in design.baselines)
        bounds[cell.name] = tuple(name for name in fit if name in cell.bounds)
        if reasons:
            unsuited[cell.name] = reasons
    manifest = Manifest(
        design=design.to_json(),
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
            make_task(entry, design, manifest, seeds=(0,), noise=0).make()
    return manifest


def _check_tuned(design: PolicyDesign, manifest: Manifest) -> None:
    """Refuse settings that no policy would use: a wrong name would otherwise go unnoticed."""
    names = {*design.baselines, *(checkpoint.recipe for checkpoint in manifest.checkpoints)}
    names |= {name for cell in design.cells for name in cell.bounds}
    configs = [cell_config(cell, (0,)) for cell in design.cells]
    for tuned in manifest.tuned:
        if tuned.policy not in names:
            raise ValueError(f"settings are given for {tuned.policy!r}, which is not run")
        if all(manifest.settings(tuned.policy, config) is None for config in configs):
            raise ValueError(
                f"settings of {tuned.policy!r} are for {tuned.estimator}, {tuned.parameters}, "
                f"{tuned.privacy}: no cell is that"
            )


def write_draft(folder: Path, drafted: Manifest) -> Manifest:
    """Put a draft into a folder, or go on with the same draft there.

    Raises:
        ValueError: The folder has another manifest.
    """
    try:
        recorded = Manifest.read(folder)
    except FileNotFoundError:
        drafted.write(folder)
        return drafted
    undecided = dataclasses.replace(recorded, choices={}, frozen="", command=drafted.command)
    if undecided.digest != drafted.digest:
        raise ValueError(
            f"{folder} has a manifest of other policies, cells or settings: choose another "
            "--output, or remove the folder to start over"
        )
    return recorded


def choose(
    design: PolicyDesign, manifest: Manifest, ledger: Ledger[Entry, EpisodeScore]
) -> Manifest:
    """Return a draft with the choices of validation traffic, by its scores in a ledger, frozen."""
    choices = {cell.name: _choice(cell, design, manifest, ledger) for cell in design.cells}
    time = datetime.now(UTC).isoformat(timespec="seconds")
    return dataclasses.replace(manifest, choices=choices, frozen=time)


def _choice(
    cell: PolicyCell, design: PolicyDesign, manifest: Manifest, ledger: Ledger[Entry, EpisodeScore]
) -> CellChoice:
    def mean_error(entry: Entry) -> float:
        scores = (ledger.rows[entry, seed] for seed in design.validation_seeds)
        return float(np.mean([-score.reward for score in scores]))

    baselines = {
        name: mean_error(Entry(cell.name, "baseline", name)) for name in manifest.ladder[cell.name]
    }
    learners = {}
    for learner in manifest.learners(cell):
        errors = [mean_error(learner.entry(seed)) for seed in manifest.runs(learner)]
        learners[learner.policy, learner.mode] = sum(errors) / len(errors)
    best = {cell.name: min(learners, key=lambda pair: learners[pair])} if learners else {}
    named = {f"{policy}, {mode}": error for (policy, mode), error in learners.items()}
    return CellChoice(
        baseline=min(baselines, key=lambda name: baselines[name]),
        learners=best,
        errors={**baselines, **named},
    )
