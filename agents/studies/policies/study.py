"""The study of policies from freezing to the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from agents import seeds as noise_seeds
from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger, ScoredT
from agents.experiments.provenance import check_folder, take_folder
from agents.experiments.reports import write_report
from agents.experiments.runner import Workplace
from agents.experiments.tasks import run_all
from agents.figures import save_figure
from agents.seeds import STUDY_TEST, STUDY_VALIDATION
from agents.statistics import crossed_t
from agents.studies.policies import rules, tables
from agents.studies.policies.curves import read_curves
from agents.studies.policies.figures import draw_cells, draw_curves, draw_queries, draw_ranking
from agents.studies.policies.freezing import (
    QUERIES,
    TEST,
    VALIDATION,
    choose,
    design_provenance,
    draft,
    write_draft,
)
from agents.studies.policies.manifest import Checkpoint, Manifest, Tuned
from agents.studies.policies.plan import DETERMINISTIC, MODES, PRIMARY, Entry, Learner, PolicyDesign
from agents.studies.policies.queries import QueryCounts
from agents.studies.policies.results import ERROR_ORACLE, PolicyResults
from agents.studies.policies.rules import POLICY_TARGETS, judge
from agents.studies.policies.running import (
    EntryTask,
    cell_config,
    count_queries,
    make_task,
    run_entry,
)
from agents.studies.policies.tables import write_summary

TEMPLATES = Path(__file__).parent
CURVES_FIGURE = "fig_curves.png"


def freeze(
    design: PolicyDesign,
    place: Workplace,
    command: str,
    *,
    checkpoints: Sequence[Checkpoint] = (),
    tuned: Sequence[Tuned] = (),
) -> tuple[Manifest, bool]:
    """Fix policies and choices before test traffic is touched.

    Returns:
        The manifest, and whether it was frozen by this call.

    Raises:
        ValueError: Test traffic has been run, or the folder is of something else.
    """
    if (place.folder / TEST).exists():
        raise ValueError(
            f"{place.folder / TEST} exists: test traffic has been run, nothing can be frozen any "
            "more. Choose another --output"
        )
    provenance = design_provenance(design)
    check_folder(place.folder, provenance)  # drafting takes a while
    drafted = draft(design, checkpoints, tuned, command)
    take_folder(place.folder, provenance)
    manifest = write_draft(place.folder, drafted)
    if manifest.frozen:
        return manifest, False
    ledger = Ledger(place.folder / VALIDATION, Entry, EpisodeScore)
    lacking = _lacking(manifest.entries(design, bounds=False), design.validation_seeds, ledger)
    _run(place, design, manifest, lacking, ledger, run_entry, design.validation_seeds)
    manifest = choose(design, manifest, ledger)
    manifest.write(place.folder)
    return manifest, True


def run(place: Workplace, n_resamples: int = 10_000) -> None:
    """Run the frozen policies and choices on test traffic, and report.

    Raises:
        FileNotFoundError: Nothing was frozen, or a frozen policy is gone that is still to be run.
        ValueError: The folder is not frozen yet, or a policy is not the one that was frozen.
    """
    manifest = Manifest.read(place.folder)
    if not manifest.frozen:
        raise ValueError(
            f"{place.folder} is not frozen yet: run the same `freeze` to its end first"
        )
    design = PolicyDesign.from_json(manifest.design)
    provenance = design_provenance(design)
    recorded = check_folder(place.folder, provenance)
    assert recorded is not None  # freezing has started the folder
    episodes = Ledger(place.folder / TEST, Entry, EpisodeScore)
    queries = Ledger(place.folder / QUERIES, Entry, QueryCounts)
    entries, seeds = manifest.entries(design), design.test_seeds
    primary = [each for each in entries if (each.cell, each.mode) == (PRIMARY, DETERMINISTIC)]
    unscored, uncounted = _lacking(entries, seeds, episodes), _lacking(primary, seeds, queries)
    if unscored or uncounted:
        for checkpoint in manifest.checkpoints:
            checkpoint.saved()
        recorded = take_folder(place.folder, provenance)
        _run(place, design, manifest, unscored, episodes, run_entry, seeds)
        _run(place, design, manifest, uncounted, queries, count_queries, seeds)
    curves = read_curves(manifest.checkpoints, PRIMARY)
    results = PolicyResults(design, manifest, episodes.rows, queries.rows, curves, n_resamples)
    draw(place.folder, results)
    write_report(place.folder, TEMPLATES, report(place.folder, results, recorded))
    write_summary(place.folder / "summary.csv", results)


def _lacking(
    entries: Sequence[Entry], seeds: Sequence[int], ledger: Ledger[Entry, ScoredT]
) -> list[Entry]:
    """Return the entries of which a ledger lacks a seed; they are run on all seeds again."""
    return [entry for entry in entries if ledger.lacking(entry, seeds)]


def _run(
    place: Workplace,
    design: PolicyDesign,
    manifest: Manifest,
    entries: Sequence[Entry],
    ledger: Ledger[Entry, ScoredT],
    work: Callable[[EntryTask], list[ScoredT]],
    seeds: tuple[int, ...],
) -> None:
    """Run entries on validation or test traffic."""
    noise = STUDY_VALIDATION.start if seeds == design.validation_seeds else STUDY_TEST.start
    for name in dict.fromkeys(entry.cell for entry in entries):
        place.record(cell_config(design.cell(name), seeds).corridor, seeds)
    tasks = [
        make_task(
            entry,
            design,
            manifest,
            seeds=seeds,
            noise=noise,
            records=place.records,
            threads=place.threads,
        )
        for entry in entries
    ]
    run_all(tasks, ledger, place.engine, work)


def draw(folder: Path, results: PolicyResults) -> None:
    """Save the figures; that of the learning curves stays as it is where trainings are gone."""
    name = results.design.cell(PRIMARY).description
    seeds = f"{len(results.design.test_seeds)} test seeds, 95 % intervals"
    save_figure(draw_ranking(results), folder / "fig_ladder.png", f"{name}; {seeds}")
    title = f"Learned policies against references; {seeds}"
    save_figure(draw_cells(results), folder / "fig_cells.png", title)
    save_figure(draw_queries(results), folder / "fig_queries.png", f"{name}: queries")
    if results.curves:
        save_figure(draw_curves(results), folder / CURVES_FIGURE, f"{name}: learning curves")


def report(folder: Path, results: PolicyResults, recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Return the names in the template of the report."""
    design, manifest, learner = results.design, results.manifest, results.primary
    verdicts = [] if learner is None else [judge(results, learner, each) for each in POLICY_TARGETS]
    best, paper = (results.schedule(PRIMARY, name) for name in results.references)
    oracle = None
    if ERROR_ORACLE in manifest.bounds[PRIMARY]:
        oracle = results.below(results.schedule(PRIMARY, ERROR_ORACLE), best)
    return {
        "design": design,
        "manifest": manifest,
        # Manifests that an earlier script froze name it.
        "freeze_command": manifest.command.replace("policy_study.py", "study.py policies"),
        "results": results,
        "tables": tables,
        "rules": rules,
        "seeds": noise_seeds,
        "best_baseline": results.references[0],
        "reference": results.references[1],
        "best_below_paper": results.below(best, paper),
        "oracle_below_best": oracle,
        "verdicts": verdicts,
        "learned": None if learner is None else _learned(results, learner),
        "has_curves": (folder / CURVES_FIGURE).exists(),
        "provenance": recorded,
    }


def _learned(results: PolicyResults, learner: Learner) -> dict[str, Any]:
    """Return the numbers of the report about the learned policy of the targets."""
    errors, hindsight = results.learned(learner), results.best_on_test(PRIMARY)
    best = results.schedule(PRIMARY, results.references[0])
    (other,) = (mode for mode in MODES if mode != learner.mode)
    counterpart = Learner(learner.cell, learner.policy, learner.trained_in, other)
    difference, p_value = crossed_t(best - errors)
    return {
        "learner": learner,
        "n_runs": len(errors),
        "hindsight": hindsight,
        "below_hindsight": results.below(errors, results.schedule(PRIMARY, hindsight)),
        "progress": results.progress(learner),
        "difference": difference,
        "p_value": p_value,
        "other_mode": other,
        "below_other_mode": results.below(errors, results.learned(counterpart)),
    }
