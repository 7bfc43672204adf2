r"""Fit the parameters of the traffic model to recorded traffic.

dptse calibrate --env dptse_env:dptse/ShortHighway-v0 --train 0:4 --held-out 1000:1002 \
    --max-evaluations 40

It compares the predictions of fitted and shipped sets on the held-out seeds.
"""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np

from agents.files import refuse_to_replace
from agents.terminal import make_table, print_table
from dptse_env.config import parse_seeds
from dptse_env.model import ARZModel, ARZParameters, available_parameters, load_parameters
from dptse_env.model.calibration import (
    PredictionError,
    TrafficSeries,
    calibrate,
    persistence_error,
    prediction_error,
)
from dptse_env.model.parameters import write_parameters
from dptse_env.release import Traffic
from dptse_env.traffic import Corridor, RecordLibrary, average_dwell
from dptse_env.utils.files import replacing
from scripts.cli import Environment, Recording

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Args(Environment, Recording):
    """Fit the ARZ parameters."""

    train: str = "0:16"
    """Traffic seeds to fit, first:stop."""
    held_out: str = "1000:1008"
    """Traffic seeds to report on; none of the above."""
    name: str = "fitted"
    """Name of the fitted set."""
    max_evaluations: int = 400
    """Models to try at most."""
    output: Path = Path("results/calibration")
    """Folder for the fitted set and the errors."""
    force: bool = False
    """Replace a set of this name in the folder."""
    json: bool = False
    """Print the fitted set as JSON, for a program, in place of tables."""


def load_series(
    corridor: Corridor, seeds: tuple[int, ...], library: RecordLibrary
) -> list[TrafficSeries]:
    """Return the aggregates of the recorded traffic of ``seeds``."""
    traffic, s = Traffic(corridor, seeds, library), corridor.n_segments
    series = []
    for index in range(len(seeds)):
        traffic.load(index)
        density, speed = np.moveaxis(traffic.complete(index), -1, 0)
        series.append(TrafficSeries(density[:, :s], speed[:, :s], density[:, s:], speed[:, s:]))
    return series


def shipped_parameters(corridor: Corridor) -> list[ARZParameters]:
    """Return the shipped sets that are stable on a corridor."""
    known = []
    for name in available_parameters():
        try:
            ARZModel(corridor, load_parameters(name)).require_time_step()
        except ValueError as problem:
            logger.info("without %s: %s", name, problem)
        else:
            known.append(load_parameters(name))
    return known


def compare(
    corridor: Corridor, candidates: list[ARZParameters], data: list[TrafficSeries]
) -> dict[str, PredictionError]:
    """Return the prediction errors of persistence and of every candidate on ``data``."""
    errors = {"persistence": persistence_error(data, corridor.n_mainline)}
    for parameters in candidates:
        errors[parameters.name] = prediction_error(ARZModel(corridor, parameters), data)
    return errors


def nearest(shipped: list[ARZParameters], errors: dict[str, PredictionError]) -> str | None:
    """Return the name of the shipped set that predicts best; None without any on this road.

    Estimators with the fitted set take its tuned settings: process noise stands for the errors of
    predictions.
    """

    def error(parameters: ARZParameters) -> float:
        found, reference = errors[parameters.name], errors["persistence"]
        density = np.divide(found.density, reference.density)
        return float(np.mean([density, np.divide(found.speed, reference.speed)]))

    return min(shipped, key=error).name if shipped else None


def print_errors(errors: dict[str, PredictionError], title: str) -> None:
    """Print density and speed errors by horizon."""
    horizons = next(iter(errors.values())).horizons
    table = make_table(
        f"{title}: density [veh/km] / speed [km/h] RMSE",
        "prediction",
        *(f"{horizon} s" for horizon in horizons),
    )
    for name, error in errors.items():
        pairs = zip(error.density, error.speed, strict=True)
        table.add_row(name, *(f"{density:.1f} / {speed:.1f}" for density, speed in pairs))
    print_table(table)


def main(args: Args) -> None:
    """Record what is missing, fit on the training seeds, report on the held-out ones."""
    train, held_out = parse_seeds(args.train, "train"), parse_seeds(args.held_out, "held_out")
    shared = sorted(set(train) & set(held_out))
    if shared:
        raise ValueError(f"held_out must not share seeds with train, both have {shared}")
    path = args.output / f"{args.name}.json"
    refuse_to_replace([path], args.force)
    corridor = args.corridor()
    library = args.library(corridor, (*train, *held_out))
    dwell = average_dwell(corridor, (library.get(corridor, seed) for seed in train))
    fit = calibrate(
        corridor, load_series(corridor, train, library), args.name,
        max_evaluations=args.max_evaluations,
    )  # fmt: skip
    shipped = shipped_parameters(corridor)
    candidates = [*shipped, fit.parameters]
    errors = compare(corridor, candidates, load_series(corridor, held_out, library))
    fitted = dataclasses.replace(fit.parameters, derived_from=nearest(shipped, errors))
    provenance = {
        "corridor": corridor.name,
        "train": args.train,
        "held_out": args.held_out,
        "loss": fit.loss,
        "n_evaluations": fit.n_evaluations,
        "at_bounds": fit.at_bounds,
        "mean_dwell": dwell,
        "date": date.today().isoformat(),
        "versions": {name: version(name) for name in ("dptse-env", "libsumo", "scipy")},
        "held_out_errors": {name: dataclasses.asdict(error) for name, error in errors.items()},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        write_parameters(temporary, fitted, provenance)
    if args.json:
        print(path.read_text(encoding="utf-8"), end="")
        return
    print_errors(errors, f"{corridor.name}, held-out seeds {args.held_out}")
    print(f"fitted: {fitted}")
    if fit.at_bounds:
        print(f"at the bounds of the search: {', '.join(fit.at_bounds)}")
    print(f"mean time on a mainline segment: {dwell:.2f} s")
    print(f"written to {path}")
