"""Replay a measured field of density and speed, and print what the estimators make of it.

python scripts/replay_field.py --source.density density.txt --source.speed speed.txt
--source.cell 0.1 --source.interval 5 --segments 6

The field is the truth. Some of its segments are queried every second, by round robin, and released
with the noise of the preset `corrected`; the segments at both ends are known without noise. Filters
have the settings that were tuned for that preset.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from agents.environments import make_config
from agents.figures import LABELS
from agents.measured_field import Replay, field_corridor, read_field
from agents.terminal import make_table, print_table
from dptse_env.estimators import EstimatorSettings
from dptse_env.importers.fields import FieldSource
from dptse_env.utils.fields import integer

PAPER = "dptse_env:dptse/PaperHighway-v0"


@dataclass(frozen=True)
class Args:
    """Replay a measured field of density and speed."""

    source: FieldSource
    """Files and their units."""
    segments: int
    """Segments that are estimated; two more are the boundary."""
    lanes: int = 5
    """Lanes of the road."""
    speed_limit: float = 105.0
    """Speed limit [km/h]."""
    bandwidth: int = 2
    """Segments that are queried every second."""
    epsilon: float = 1.0
    """Epsilon of the preset `corrected`."""
    delta: float = 0.05
    """Its delta."""
    window: int = 450
    """Seconds of each of the windows that the field is cut into."""
    repeats: int = 8
    """Draws of the noise."""
    estimators: tuple[str, ...] = ("ekf", "ukf", "random_walk", "blend", "recurrent")
    """Estimators."""
    weights: str = "highway"
    """Network of the estimator `recurrent`, by name or file."""
    json: bool = False
    """Print the errors as JSON, for a program, in place of a table."""


def main(args: Args) -> None:
    """Print the errors of every estimator."""
    measured = read_field(args.source, args.segments)
    corridor = field_corridor(measured, args.lanes, args.speed_limit)
    integer("bandwidth", args.bandwidth, 1, corridor.n_mainline)
    integer("window", args.window, 61, len(measured.density) - 1)
    integer("repeats", args.repeats, 1, 1000)
    base = make_config(PAPER, {"privacy": "corrected"})
    replay = Replay(
        measured, corridor, base.arz_parameters, args.bandwidth, args.epsilon, args.delta,
        args.window, args.repeats,
    )  # fmt: skip
    scores = {name: replay.run(name, settings(args, name)) for name in args.estimators}
    if args.json:
        print(json.dumps({name: score._asdict() for name, score in scores.items()}, indent=2))
        return
    density, speed = replay.sigma
    table = make_table(
        f"noise: {density:.1f} veh/km, {speed:.1f} km/h",
        "estimator", "error x 1000", "density [veh/km]", "speed [km/h]", "chi2 density",
        "chi2 speed",
    )  # fmt: skip
    for name, score in scores.items():
        table.add_row(LABELS[name], *(f"{value:.2f}" for value in score))
    print_table(table)


def settings(args: Args, estimator: str) -> EstimatorSettings:
    """Return the settings of an estimator: those tuned for the preset."""
    keywords: dict[str, Any] = {"privacy": "corrected", "estimator": estimator}
    if estimator == "recurrent":
        recurrent = {"weights": args.weights, "outside": True}
        keywords["estimator_settings"] = {"recurrent": recurrent}
    found: EstimatorSettings = make_config(PAPER, keywords).settings()
    return found
