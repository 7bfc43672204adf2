r"""Replay a measured field of density and speed with the estimators.

dptse replay-field --density density.txt --speed speed.txt --cell 0.1 --interval 5 \
    --segments 6 --window 90 --repeats 2

The field is the truth. Some of its segments are queried every second, by round robin, and released
with the noise of the environment; the segments at both ends are known without noise. Estimators
have the environment's settings.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from agents.environments import make_config, parse_env
from agents.figures import LABELS
from agents.measured_field import Replay, field_corridor, read_field
from agents.terminal import make_table, print_table
from dptse_env.importers.fields import FieldSource
from dptse_env.utils.fields import integer, require
from scripts.cli import Environment

ENV = 'dptse_env:dptse/PaperHighway-v0 {"privacy": "corrected", "bandwidth": 2}'


@dataclass(frozen=True, kw_only=True)
class Args(Environment):
    """Replay a measured field of density and speed."""

    source: Annotated[FieldSource, arg(name="")]
    segments: int
    """Segments that are estimated; two more are the boundary."""
    lanes: int = 5
    """Lanes of the road."""
    speed_limit: float = 105.0
    """Speed limit [km/h]."""
    env: str = ENV
    """Environment of noise, bandwidth and settings, as above: an id and keywords as JSON."""
    window: int = 450
    """Seconds of each of the windows that the field is cut into."""
    repeats: int = 8
    """Draws of the noise."""
    estimators: tuple[str, ...] = ("ekf", "ukf", "random_walk", "blend", "recurrent")
    """Estimators."""
    json: bool = False
    """Print JSON, for a program, in place of a table."""


def main(args: Args) -> None:
    """Print the errors of every estimator."""
    env, keywords = parse_env(args.env)
    configs = [make_config(env, {**keywords, "estimator": each}) for each in args.estimators]
    require(bool(configs), "estimators", "one or more", args.estimators)
    base = configs[0]
    require(base.privacy.preset == "corrected", "privacy", "'corrected'", base.privacy.preset)
    measured = read_field(args.source, args.segments, args.lanes, args.speed_limit)
    corridor = field_corridor(measured, args.lanes, args.speed_limit)
    replay = Replay(
        measured,
        corridor,
        base.arz_parameters,
        integer("bandwidth", base.bandwidth, 1, corridor.n_mainline),
        base.privacy.epsilon,
        base.privacy.delta,
        integer("window", args.window, 61, len(measured.density) - 1),
        integer("repeats", args.repeats, 1, 1000),
    )
    scores = {
        name: replay.run(name, config.settings())
        for name, config in zip(args.estimators, configs, strict=True)
    }
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
        table.add_row(LABELS.get(name, name), *(f"{value:.2f}" for value in score))
    print_table(table)
