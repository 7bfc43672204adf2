r"""Fit parameters, estimator and query policy to a road, and write them into its file.

dptse fit my-road.toml

It records traffic that is missing, fits ARZ parameters on training traffic, chooses an estimator
and a query policy on validation traffic, and plays them once on test traffic. The folder
my-road-fit gets fit.md, which says what to do next. With --tune it searches settings of estimators
instead, of the road or of --env. The same command goes on after Ctrl-C.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from agents.environments import heading, make_config, parse_env, quietly
from agents.executors import make_executor
from agents.figures import save_figure
from agents.files import check_plan, keep_plan
from agents.fitting.budget import Errors, play_budgets
from agents.fitting.choice import (
    ESTIMATORS_TRIED,
    FILTER,
    POLICIES_TRIED,
    PRESENT,
    ROUND_ROBIN,
    Choice,
)
from agents.fitting.page import DIAGRAM, PAGE, draw_diagram, reason, verdict, write_page
from agents.fitting.parameters import Fit, fit_parameters, is_stable, start_from, traffic_of
from agents.fitting.road import PLAYED, Road, find_road, require_road, seeds_of
from agents.fitting.road_file import copy_of, write_choice
from agents.play import Cell
from agents.search.space import SPACE, Extra
from agents.search.tuning import Search, chosen, tune, write_set
from agents.seeds import KINDS, TUNING
from agents.tables import Labels
from agents.terminal import make_table
from dptse_env.estimators import check_estimator
from dptse_env.estimators.tuned import DEFAULT_PARAMETERS, tuned_with
from dptse_env.model import available_parameters, load_parameters
from dptse_env.model.parameters import write_parameters
from dptse_env.traffic import RecordLibrary, ranges
from dptse_env.traffic.roads import from_home
from dptse_env.utils.files import replacing, require_output
from dptse_env.utils.validation import integer, require
from dptse_env.versions import code_version
from scripts.cli import (
    Command,
    Environment,
    Estimators,
    Machines,
    Policies,
    Seed,
    TestSeeds,
    TrainSeeds,
    ValidationSeeds,
    require_open,
)

STAGES, SEARCH, JOURNAL = "stages", "search.json", "trials.journal"


@dataclass(frozen=True, kw_only=True)
class Args(
    Command, Environment, TrainSeeds, ValidationSeeds, TestSeeds, Policies, Estimators, Machines,
    Seed,
):  # fmt: skip
    """Fit a road."""

    train_seeds: Annotated[str | None, arg(metavar="STR")] = None
    """Traffic seeds to fit to, of 0 to 999; 0:8 if not given."""
    validation_seeds: Annotated[str | None, arg(metavar="STR")] = None
    """Seeds to choose on, of 1000 to 1999; 1000:1016 if not given."""
    test_seeds: Annotated[str | None, arg(metavar="STR")] = None
    """Seeds of the results, of 2000 to 2999; 2000:2016 if not given."""
    road: Annotated[Path | None, Positional, arg(metavar="[ROAD]")] = None
    """Road file, of a road of your own, an import or a SUMO network."""
    env: str = "dptse_env:dptse/PrivateHighway-v1"
    trials: int = 60
    """Sets of ARZ parameters, or of settings, to try."""
    estimators: tuple[str, ...] = ()
    """Estimators to choose from, or to tune; all suitable ones if none."""
    policies: tuple[str, ...] = ()
    """Query policies to choose from; with --tune the one that is played."""
    keep_fitted: bool = False
    """Write fitted parameters even if they are no better."""
    output: Path | None = None
    """Folder of the results; NAME-fit beside NAME.toml if not given."""
    tune: bool = False
    """Tune settings instead."""
    also: tuple[Extra, ...] = ()
    """Further settings to tune; 'demand' are demand states with their noise."""
    force: bool = False
    """Replace tuned sets that have no trials."""


OF_FIT = "validation_seeds", "test_seeds", "keep_fitted", "executor", "address"
OF_TUNE = "also", "seed", "force"


def main(args: Args) -> None:
    """Fit a road, or tune settings."""
    integer("trials", args.trials, 1)
    if args.tune:
        args.require_unset("with --tune", *OF_FIT)
        tune_settings(args)
        return
    args.require_unset("without --tune", *OF_TUNE)
    if args.road is None:
        raise ValueError("road must be given, unless with --tune")
    fit_road(args, args.road)


def tune_settings(args: Args) -> None:
    """Record what is missing, run the trials that are missing, and write the sets."""
    searches, folder = make_searches(args)
    journal = folder / JOURNAL
    foreign = [f"{n}.json" for n, search in searches.items() if not search.is_begun(journal)]
    require_output(folder, foreign, force=args.force)
    columns = "set", "settings", "reward", "density RMSE\n[veh/km]", "speed RMSE\n[km/h]"
    cell = next(iter(searches.values())).cell
    title = f"{heading(cell.env, cell.keywords)}: scores on the tuning traffic"
    table, found = make_table(title, *columns, left=2), {}
    executor = make_executor("local", args.workers or 1)
    for name, search in searches.items():
        args.library(search.config.corridor, search.seeds)
        study = tune(search, journal, args.trials, executor)
        settings = write_set(search, study, folder / f"{name}.json")
        found[name] = {"estimator": search.estimator, "estimator_settings": settings}
        for label, trial in chosen(study).items():
            errors = [f"{trial.user_attrs[key]:.2f}" for key in ("rmse_density", "rmse_speed")]
            table.add_row(name, label, f"{trial.value:.5f}", *errors)
        table.add_section()
    said = [json.dumps(keywords) for keywords in found.values()]
    args.answer(found, table, f"sets are in {folder}/; as keywords of the environment:", *said)


def make_searches(args: Args) -> tuple[dict[str, Search], Path]:
    """Return the searches by the names of their sets, all of them checked, and their folder.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: An argument is out of range.
    """
    integer("seed", args.seed, 0)
    policies = args.policies or ("shift-ahead",)
    require(len(policies) == 1, "policies", "one with --tune", policies)
    env, keywords = parse_env(args.env)
    require_open(keywords, "estimator", "action")
    folder = Path("results") / "tuning"
    if args.road is not None:
        require_road(args.road)
        require("corridor" not in keywords, "env.corridor", "left out with a road", keywords)
        keywords["corridor"] = str(args.road)
        folder = folder_of(args.road) / "tuned"
    corridor = dataclasses.replace(args, env=f"{env} {json.dumps(keywords)}").corridor()
    seeds = seeds_of("training", args.train_seeds, corridor, str(args.road or env))
    found = {}
    for estimator in args.estimators or SPACE:
        own = {**keywords, "estimator": estimator}
        cell = Cell(env, policies[0], own, noise_seed=TUNING.start, seeds=seeds)
        search = Search(cell, args.also, args.seed, args.records)
        _ = search.space
        cell.check()
        found[search.name] = search
    return found, args.output or folder


def folder_of(road: Path) -> Path:
    """Return the folder of the fit of a road file, where no other one is given."""
    return road.with_name(f"{road.stem}-fit")


def fit_road(args: Args, path: Path) -> None:
    """Fit, choose, evaluate, and write the page and the road file."""
    folder = args.output or folder_of(path)
    road, stages, copy = checked_road(args, path, folder), folder / STAGES, copy_of(path)
    args.remark("[1/4] record traffic")
    library = args.library(road.config.corridor, road.all_seeds)
    dwell = road.measure_dwell(library)
    keep_plan(folder, road.plan(args.trials))
    road.write_played(stages, dwell)
    choice = Choice(road, args.place(stages), shipped_sets(road))
    args.remark("[2/4] fit ARZ parameters")
    density, speed = traffic_of(road.config.corridor, road.seeds["training"], library)
    fit = fitted(choice, library, args.trials, 1.01 * float(density.max()))
    name = fit.parameters.name
    keep(folder / f"{name}.json", fit, road)
    choice.sets[name] = {"parameters": str(folder / f"{name}.json")}
    args.remark("[3/4] choose an estimator with its parameters, and a query policy")
    policies = [{"policy": each} for each in args.policies or POLICIES_TRIED]
    choice.settle(estimators_tried(choice, args, name), policies)
    note_parameters(choice, fit)
    args.remark("[4/4] evaluate on test traffic, and over bandwidth and epsilon")
    finalists = [*choice.finalists("estimator"), *choice.finalists("policy")]
    compared = [{**each, "traffic": "test"} for each in finalists]
    played = choice.play([choice.tested, choice.plain, *compared])
    budgets = play_budgets(choice)

    keywords = chosen_keywords(choice, road)
    choice.notes += [*inherits(choice, keywords), *road.remarks]
    if road.is_of_records and road.config.release_model.claims_guarantee:
        choice.notes.append(
            f"{path} names under `measured` what depends on the vehicles of its records, which "
            "voids the guarantee for them. To have one, release only other traffic, such as "
            "another day's, and empty `measured`"
        )
    n = road.corridor.geometry.n_mainline
    sets = {
        each: choice.cell(choice.labels("test", parameters=each)).config.parameters
        for each in (choice.home, name)
    }
    diagram = draw_diagram(density[:, :n], speed[:, :n], sets)
    save_figure(diagram, folder / DIAGRAM, f"{road.corridor.name}, training traffic")
    write_page(choice, played, budgets, following(args, choice, folder), folder)
    changed = write_choice(
        path,
        {key: _in_file(path, value) for key, value in keywords.items()},
        dwell if "average_dwell" in road.assumed else None,
        of_records=road.is_of_records,
    )
    said = [verdict(choice), *(f"- {each}" for each in (reason(choice), *choice.notes))]
    if changed:
        said.append(f"{path} has the table [environment] now; {copy} is as it was")
    said.append(f"{folder / PAGE} has the tables, and says what to do next")
    args.answer(as_json(choice, keywords, played, budgets), *said)


def checked_road(args: Args, path: Path, folder: Path) -> Road:
    """Return a road after all that is given was checked, before any work."""
    for estimator in args.estimators:
        check_estimator(estimator, "compiled")
    given = args.train_seeds, args.validation_seeds, args.test_seeds
    road = find_road(path, args.env, folder, dict(zip(KINDS, given, strict=True)))
    for policy in args.policies:
        road.cell(policy).check()
    copy = copy_of(path)
    require_output(copy.parent, [copy.name], force=True)
    check_plan(folder, road.plan(args.trials))
    return road


def as_json(
    choice: Choice, keywords: Mapping[str, Any], played: Sequence[Labels], budgets: Errors
) -> dict[str, Any]:
    """Return what was chosen, and the errors x 1000 on each seed of validation and test traffic."""

    def with_errors(of: Sequence[Labels]) -> list[Labels]:
        return [{**each, "error": choice.errors(each).tolist()} for each in of]

    return {
        **{key: getattr(choice, key) for key in ("parameters", "estimator", "policy", "notes")},
        "environment": keywords,
        "validation": {what: with_errors(each) for what, each in choice.compared.items()},
        "test": with_errors(played),
        "budgets": [
            {"bandwidth": bandwidth, "epsilon": epsilon, "error": errors.tolist()}
            for (bandwidth, epsilon), errors in budgets.items()
        ],
    }


def shipped_sets(road: Road) -> dict[str, dict[str, Any]]:
    """Return the keywords of the shipped parameters that are stable on a road, inherited first."""
    names = dict.fromkeys((road.inherited, *available_parameters()))
    stable = [name for name in names if is_stable(load_parameters(name), road.corridor)]
    return {name: {"parameters": name} for name in stable}


def fitted(choice: Choice, library: RecordLibrary, trials: int, densest: float) -> Fit:
    """Search parameters, from the shipped set with which the filter errs least in training."""
    road, base = choice.road, DEFAULT_PARAMETERS
    plain = {"estimator": FILTER, "policy": ROUND_ROBIN}
    if choice.sets:
        options = [choice.labels("training", parameters=name, **plain) for name in choice.sets]
        base = choice.best(choice.play(options))["parameters"]
    name = road.corridor.name
    name = f"{name}-road" if name in available_parameters() else name
    start = start_from(load_parameters(base), road.corridor, name)
    cell = choice.cell(choice.labels("training", parameters="", **plain))
    kept = choice.place.folder / SEARCH
    return fit_parameters(cell, road.config.corridor, start, densest, library, trials, kept)


def keep(path: Path, fit: Fit, road: Road) -> None:
    """Write the fitted set with its provenance."""
    provenance = {
        "corridor": road.corridor.name,
        "env": road.env,
        "training": ranges(road.seeds["training"]),
        "error_at_start": fit.start,
        "error": fit.error,
        "at_bounds": fit.at_bounds,
        "version": code_version(),
    }
    with replacing(path) as temporary:
        write_parameters(temporary, fit.parameters, provenance)


def estimators_tried(choice: Choice, args: Args, name: str) -> list[Labels]:
    """Return the estimators with inherited and fitted parameters, and begin with what there is.

    What the road file has already comes first, unless fitted parameters are kept in any case.
    """
    road, sets = choice.road, [name] if args.keep_fitted else [choice.home, name]
    options: list[Labels] = [
        {"estimator": estimator, "parameters": each}
        for estimator in args.estimators or ESTIMATORS_TRIED
        for each in dict.fromkeys(sets)
    ]
    choice.parameters = sets[0]
    if road.present and not args.keep_fitted:
        choice.sets[PRESENT] = dict(road.present)
        choice.parameters = PRESENT
        choice.estimator = str(road.present.get("estimator", road.config.estimator))
        options.insert(0, {"estimator": choice.estimator, "parameters": PRESENT})
    return options


def note_parameters(choice: Choice, fit: Fit) -> None:
    """Note what the fit of the parameters gave."""
    name = fit.parameters.name
    choice.notes.append(
        f"on training traffic the search took the error x 1000 of an EKF from {fit.start:.1f}, "
        f"with {fit.parameters.derived_from}, to {fit.error:.1f}"
    )
    v_f, limit = fit.parameters.free_flow_speed, choice.road.corridor.geometry.largest_speed_limit
    if v_f > limit and not any("free_flow_speed" in each for each in fit.at_bounds):
        choice.notes.append(
            f"v_f is {v_f:g} km/h where {limit:g} are allowed: it extrapolates the curve to an "
            "empty road, gamma and the jam density compensate it, and nobody drives at it"
        )
    own, other = (
        choice.labels("validation", parameters=each) for each in (name, choice.parameters)
    )
    if choice.parameters != name and own in choice.compared["estimator"]:
        choice.notes.append(
            f"the fitted parameters are not written: on validation traffic {choice.estimator} errs "
            f"{choice.errors(own).mean():.1f} with them and {choice.errors(other).mean():.1f} with "
            f"{choice.parameters}, which is no certain gain; --keep-fitted writes them"
        )
    choice.notes += fit.at_bounds


def chosen_keywords(choice: Choice, road: Road) -> dict[str, Any]:
    """Return the keywords of an environment that a fit has decided."""
    decided = {key: value for key, value in road.keywords.items() if key in road.decided}
    return {
        **decided,
        **choice.sets[choice.parameters],
        "estimator": choice.estimator,
    }


def inherits(choice: Choice, keywords: Mapping[str, Any]) -> list[str]:
    """Say which values of other roads stay in force, as a warning does."""
    road = choice.road
    played = {**road.keywords, **keywords, "corridor": str(choice.place.folder / PLAYED)}
    with quietly():
        config = make_config(road.env, played)
    settings = (
        f"nobody tuned the settings of {choice.estimator}"
        if config.settings_name is None
        else f"the settings {config.settings_name} were tuned on another road with "
        f"{tuned_with(config.parameters)}"
    )
    said = {
        "estimator_settings": f"{settings}: dptse fit --tune makes settings of your own",
        **config.made_for(),
    }
    return [said.get(key, f"{key} is of another road") for key in config.inherited]


def following(args: Args, choice: Choice, folder: Path) -> str:
    """Return what to do next, as command lines that run."""
    road, quote = choice.road, shlex.quote
    given = {**parse_env(args.env)[1], "corridor": road.path.as_posix()}
    env = quote(f"{road.env} {json.dumps(given)}")
    train, validation, test = (f"{each[0]}:{each[-1] + 1}" for each in road.seeds.values())
    evaluation, policy, comparison, tuned = (
        quote(str(folder / name)) for name in ("evaluation", "policy", "comparison", "tuned")
    )
    rules = " ".join(dict.fromkeys((ROUND_ROBIN, quote(choice.policy))))
    evaluate = f"""\
dptse evaluate --env {env} \\
    --test-seeds {test} --reference {ROUND_ROBIN} --policies {rules}"""
    return f"""\
# look at episodes of the chosen policy in a browser
{evaluate} --html --output {evaluation}
# train a query policy, some minutes, and compare it with the rules
dptse train --env {env} \\
    --steps 300000 --train-seeds {train} --validation-seeds {validation} --output {policy}
{evaluate} {policy}/best.safetensors --output {comparison}
# tune the EKF on this road, and name the file in the table [environment] of the road file
dptse fit --tune {quote(str(road.path))} --env {quote(args.env)} \\
    --estimators {FILTER} --policies {ROUND_ROBIN} --also demand noise-scale \\
    --train-seeds {train} --output {tuned}
"""


def _in_file(path: Path, value: Any) -> Any:
    """Return a value as the road file has it: names of files start at its folder."""
    is_file = isinstance(value, str) and value.endswith(".json")
    return from_home(path, value) if is_file else value
