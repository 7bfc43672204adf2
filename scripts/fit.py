r"""Fit parameters, estimator and query rule to a road, and write them into its file.

dptse fit my-road.toml

It records traffic that is missing, fits ARZ parameters by the filter's error on training traffic,
chooses parameters, estimator and query rule on validation traffic, and plays them once on test
traffic. The folder my-road-fit gets page.html, which says what to do next. The same command goes on
after Ctrl-C.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from agents.environments import make_config, parse_env, quietly
from agents.fitting.choice import (
    ESTIMATORS_TRIED,
    FILTER,
    PRESENT,
    ROUND_ROBIN,
    RULES_TRIED,
    Choice,
)
from agents.fitting.page import Outcome, answer, write
from agents.fitting.parameters import Fit, fit_parameters, is_stable, start_from, traffic_of
from agents.fitting.road import PLAYED, Road, find_road
from agents.fitting.road_file import copy_of, write_choice
from agents.play import record
from agents.study import Place
from agents.tables import ERROR, Labels, values
from dptse_env.estimators import check_estimator
from dptse_env.estimators.tuned import DEFAULT_PARAMETERS, tuned_with
from dptse_env.model import ARZParameters, available_parameters, load_parameters
from dptse_env.model.parameters import read_parameters, write_parameters
from dptse_env.schedules import SCHEDULES
from dptse_env.traffic import RecordLibrary, ranges
from dptse_env.traffic.roads import from_home
from dptse_env.utils.files import replacing, require_output, write_atomically
from dptse_env.utils.validation import integer, require
from dptse_env.versions import code_version
from scripts.cli import Machines

PAGE, STAGES, SEARCH = "page.html", "stages", "search.json"
STEPS = (
    "record traffic", "fit ARZ parameters", "choose parameters", "choose an estimator",
    "choose a query rule", "evaluate on test traffic",
)  # fmt: skip


@dataclass(frozen=True)
class Args(Machines):
    """Fit a road."""

    road: Positional[Path] = Path("my-road.toml")
    """Road file, of a road of your own, an import or a SUMO network."""
    env: str = "dptse_env:dptse/PrivateHighway-v1"
    """Environment to fit for: an id, or an id and keywords as JSON, 'ID {"bandwidth": 3}'."""
    training: str | None = None
    """Traffic seeds to fit on, first:stop; 0:8, or all training windows of an import."""
    validation: str | None = None
    """Traffic seeds to choose on; 1000:1008, or all validation windows."""
    test: str | None = None
    """Traffic seeds to evaluate on; 2000:2016, or all test windows."""
    tries: int = 60
    """Sets of ARZ parameters to try."""
    estimators: tuple[str, ...] = ESTIMATORS_TRIED
    """Estimators to choose from."""
    rules: tuple[str, ...] = RULES_TRIED
    """Query rules to choose from."""
    keep_fitted: bool = False
    """Write the fitted parameters even where they do not lower the filter's error."""
    output: Path | None = None
    """Folder of the fit; NAME-fit beside NAME.toml if not given."""
    json: bool = False
    """Print JSON, for a program, in place of text."""


def main(args: Args) -> None:
    """Fit, choose, evaluate, and write the page and the road file."""
    integer("tries", args.tries, 1)
    for estimator in args.estimators:
        check_estimator(estimator, "compiled")
    for rule in args.rules:
        SCHEDULES.find(rule)
    require(bool(args.estimators and args.rules), "estimators and rules", "not empty", "none")
    folder = args.output or args.road.with_name(f"{args.road.stem}-fit")
    seeds = {"training": args.training, "validation": args.validation, "test": args.test}
    road, stages = find_road(args.road, args.env, folder, seeds), folder / STAGES
    require_output(folder, own=[STAGES])
    copy = copy_of(args.road)
    require_output(copy.parent, [copy.name], force=True)
    road.check(stages, args.tries)
    place = args.place(stages)

    begin(0)
    library = RecordLibrary(args.records)
    record(road.corridor, road.all_seeds, library, progress=True, workers=args.workers)
    dwell = road.measure_dwell(library)
    road.begin(stages, args.tries, dwell)
    choice = Choice(road, stages, shipped_sets(road))
    begin(1)
    density, speed = traffic_of(road.corridor, road.seeds["training"], library)
    fit = fitted(choice, place, library, args.tries, 1.01 * float(density.max()))
    name = fit.parameters.name
    keep(folder / f"{name}.json", fit, road)
    choice.sets[name] = {"parameters": str(folder / f"{name}.json")}
    notes = choose(choice, fit, place, args)
    begin(5)
    rows = choice.play(test_cells(choice, args), place)

    keywords = chosen_keywords(choice, road)
    notes += [*inherits(choice, keywords), *road.remarks, *dict.fromkeys(choice.refused)]
    sets = {each: arz(choice, each) for each in dict.fromkeys((choice.home, name))}
    outcome = Outcome(choice, sets, density, speed, dwell, notes, commands(args, choice, folder))
    write_atomically(folder / PAGE, write(outcome, rows, place))
    changed = write_choice(
        args.road,
        {key: _in_file(args.road, value) for key, value in keywords.items()},
        dwell if "average_dwell" in road.assumed else None,
    )
    if args.json:
        print(json.dumps(as_json(choice, keywords, notes, rows), indent=2))
        return
    print(answer(choice))
    for note in notes:
        print(f"- {note}")
    if changed:
        print(f"{args.road} has the table [environment] now; {copy} is as it was")
    print(f"open {folder / PAGE} in a browser: it says what to do next")


def choose(choice: Choice, fit: Fit, place: Place, args: Args) -> list[str]:
    """Choose parameters, estimator and query rule; return notes on the parameters."""
    begin(2)
    choice.parameters = choice.home
    choice.choose([{"parameters": name} for name in choice.sets], place)
    notes = notes_on(choice, fit)
    if args.keep_fitted:
        choice.parameters = fit.parameters.name
    begin(3)
    options: list[Mapping[str, str]] = [{"estimator": name} for name in args.estimators]
    present = choice.road.present
    if present:
        choice.sets[PRESENT] = dict(present)
        estimator = str(present.get("estimator", choice.road.config.estimator))
        options.append({"parameters": PRESENT, "estimator": estimator})
    choice.choose(options, place)
    begin(4)
    choice.choose([{"rule": name} for name in args.rules], place)
    return notes


def as_json(
    choice: Choice, keywords: Mapping[str, Any], notes: Sequence[str], rows: Sequence[Labels]
) -> dict[str, Any]:
    """Return what was chosen, and the errors x 1000 on each seed of test traffic."""
    return {
        "parameters": choice.parameters,
        "estimator": choice.estimator,
        "rule": choice.rule,
        "environment": keywords,
        "notes": notes,
        "test": [
            {**labels, "error": values(choice.rows, labels, ERROR).tolist()} for labels in rows
        ],
    }


def begin(step: int) -> None:
    """Say which step begins."""
    print(f"[{step + 1}/{len(STEPS)}] {STEPS[step]}", file=sys.stderr)


def shipped_sets(road: Road) -> dict[str, dict[str, Any]]:
    """Return the keywords of the shipped parameters that are stable on a road, inherited first."""
    names = dict.fromkeys((road.inherited, *available_parameters()))
    stable = [name for name in names if is_stable(load_parameters(name), road.corridor)]
    return {name: {"parameters": name} for name in stable}


def fitted(choice: Choice, place: Place, library: RecordLibrary, tries: int, densest: float) -> Fit:
    """Search parameters, from the shipped set with which the filter errs least in training."""
    road, base = choice.road, DEFAULT_PARAMETERS
    if choice.sets:
        options = [
            choice.labels("training", parameters=name, estimator=FILTER, rule=ROUND_ROBIN)
            for name in choice.sets
        ]
        base = choice.best(choice.play(options, place))["parameters"]
    name = road.corridor.name
    name = f"{name}-road" if name in available_parameters() else name
    start = start_from(load_parameters(base), road.corridor, name)
    labels = choice.labels("training", parameters="", estimator=FILTER, rule=ROUND_ROBIN)
    return fit_parameters(
        road.corridor, choice.cell(labels), road.seeds["training"], start, densest, library, tries,
        choice.stages / SEARCH,
    )  # fmt: skip


def keep(path: Path, fit: Fit, road: Road) -> None:
    """Write the fitted set with its provenance, unless it is there: its date is part of rows."""
    if path.exists() and read_parameters(path) == fit.parameters:
        return
    provenance = {
        "corridor": road.corridor.name,
        "env": road.env,
        "training": ranges(road.seeds["training"]),
        "error_at_start": fit.start,
        "error": fit.error,
        "at_bounds": fit.at_bounds,
        "date": date.today().isoformat(),
        "version": code_version(),
    }
    with replacing(path) as temporary:
        write_parameters(temporary, fit.parameters, provenance)


def notes_on(choice: Choice, fit: Fit) -> list[str]:
    """Say what the fit of the parameters gave, after they were chosen on validation traffic."""
    name = fit.parameters.name
    found = [
        f"on training traffic the search took the error x 1000 of an EKF from {fit.start:.1f}, "
        f"with {fit.parameters.derived_from}, to {fit.error:.1f}"
    ]
    if choice.parameters != name:
        errors = [
            values(choice.rows, choice.labels("validation", parameters=each), ERROR).mean()
            for each in (name, choice.parameters)
        ]
        found.append(
            f"the fitted parameters are not written: on validation traffic an EKF errs "
            f"{errors[0]:.1f} with them and {errors[1]:.1f} with {choice.parameters}, which is no "
            "certain gain; --keep-fitted writes them"
        )
    return [*found, *fit.at_bounds]


def test_cells(choice: Choice, args: Args) -> list[Labels]:
    """Return what is played on test traffic: what was chosen, and what it is compared with."""
    plain = {"estimator": FILTER, "rule": ROUND_ROBIN}
    wanted = [
        choice.labels("test"),
        choice.labels("test", parameters=choice.home, **plain),
        choice.labels("test", **plain),
        choice.labels("test", rule=ROUND_ROBIN),
    ]
    wanted += [choice.labels("test", estimator=e, rule=ROUND_ROBIN) for e in args.estimators]
    wanted += [choice.labels("test", rule=rule) for rule in args.rules]
    return [dict(each) for each in dict.fromkeys(tuple(labels.items()) for labels in wanted)]


def chosen_keywords(choice: Choice, road: Road) -> dict[str, Any]:
    """Return the keywords of an environment that a fit has decided."""
    decided = {key: value for key, value in road.keywords.items() if key in road.decided}
    chosen = choice.sets[choice.parameters]
    if chosen.get("parameters") == road.inherited:
        chosen = {}
    return {**decided, **chosen, "estimator": choice.estimator}


def inherits(choice: Choice, keywords: Mapping[str, Any]) -> list[str]:
    """Say which values of other roads stay in force, as ``info["inherited"]`` does."""
    road = choice.road
    with quietly():
        config = make_config(
            road.env,
            {**road.keywords, **keywords, "corridor": str(choice.stages / PLAYED)},
        )
    said = {
        "parameters": f"the parameters {config.parameters.name} were fitted to another road",
        "estimator_settings": (
            f"the settings {config.settings_name} were tuned on another road with "
            f"{tuned_with(config.parameters)}: dptse tune makes settings of your own"
        ),
    }
    return [said.get(key, f"{key} is of another road") for key in config.inherited]


def arz(choice: Choice, name: str) -> ARZParameters:
    """Return the ARZ parameters of a set."""
    given = str(choice.sets[name]["parameters"])
    return load_parameters(given) if given in available_parameters() else read_parameters(given)


def commands(args: Args, choice: Choice, folder: Path) -> list[tuple[str, str]]:
    """Return what to do next, as command lines that run."""
    road = choice.road
    given = {**parse_env(args.env)[1], "corridor": args.road.as_posix()}
    env = shlex.quote(f"{road.env} {json.dumps(given)}")
    seeds = {kind: f"{each[0]}:{each[-1] + 1}" for kind, each in road.seeds.items()}
    rules = " ".join(dict.fromkeys((ROUND_ROBIN, choice.rule)))
    start, policy = f"--env {env}", folder / "policy"
    return [
        (
            "Look at episodes of the chosen rule in a browser:",
            f"dptse evaluate {start} --schedules {rules} --reference {ROUND_ROBIN} "
            f"--seeds {seeds['test']} --html --output {folder / 'evaluation'}",
        ),
        (
            "Train a query policy, some minutes:",
            f"dptse train {start} --steps 300000 "
            f"--train-seeds {seeds['training']} --validation-seeds {seeds['validation']} "
            f"--output {policy}",
        ),
        (
            "Compare it with the rules:",
            f"dptse evaluate {start} --schedules {rules} --reference {ROUND_ROBIN} "
            f"--policies {policy / 'best.safetensors'} --seeds {seeds['test']} "
            f"--output {folder / 'comparison'}",
        ),
        (
            "Tune the settings of the EKF on this road, and name the file that it writes in the "
            "table [environment] of the road file:",
            f"dptse tune {start} --estimators {FILTER} --schedule {ROUND_ROBIN} "
            f"--also demand noise-scale --seeds {seeds['training']} --output {folder / 'tuned'}",
        ),
    ]


def _in_file(path: Path, value: Any) -> Any:
    """Return a value as the road file has it: names of files start at its folder."""
    is_file = isinstance(value, str) and value.endswith(".json")
    return from_home(path, value) if is_file else value
