r"""Replay a measured field of density and speed with the estimators.

dptse replay-field --density density.txt --speed speed.txt --cell 0.1 \
    --interval 5 --segments 6 --window 90 --repeats 2

The field is the truth. Some of its segments are queried every second, by round robin, and released
with noise; the segments at both ends are known.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import arg

from agents.environments import make_config, quietly
from agents.figures import LABELS
from agents.measured_field import Replay, field_corridor, read_field
from agents.terminal import make_table, print_table
from dptse_env.importers.fields import FieldSource
from dptse_env.utils.validation import integer, parse_json, require

ENV = "dptse_env:dptse/PaperHighway-v0"
ESTIMATORS = ("ekf", "ukf", "random_walk", "blend", "asm", "recurrent", "mixture")


@dataclass(frozen=True, kw_only=True)
class Args:
    """Replay a measured field of density and speed."""

    source: Annotated[FieldSource, arg(name="")]
    segments: int
    """Segments that are estimated; two more are the boundary."""
    lanes: int = 5
    """Lanes of the road."""
    speed_limit: float = 105.0
    """Speed limit [km/h]."""
    parameters: str = "w99-3lane"
    """ARZ parameters: a shipped set or a JSON file."""
    settings: str | None = None
    """Estimator settings: a set, a JSON file or JSON; else tuned ones."""
    preset: str = "corrected"
    """Release model of the noise, one that needs no vehicles."""
    epsilon: float = 1.0
    """Privacy parameter of the noise."""
    bandwidth: int = 2
    """Segments that are queried a second."""
    window: int = 450
    """Seconds of each of the windows that the field is cut into."""
    repeats: int = 8
    """Draws of the noise."""
    estimators: tuple[str, ...] = ESTIMATORS
    """Estimators."""
    json: bool = False
    """Print JSON, for a program, in place of a table."""

    def keywords(self) -> dict[str, Any]:
        """Return keywords of an environment, without road and estimator."""
        settings: Any = self.settings or {}
        if isinstance(settings, str) and settings.lstrip().startswith("{"):
            settings = parse_json(settings, "settings")
        return {
            "parameters": self.parameters,
            "estimator_settings": settings,
            "privacy": self.preset,
            "epsilon": self.epsilon,
            "bandwidth": self.bandwidth,
        }


def main(args: Args) -> None:
    """Print the errors of every estimator."""
    require(bool(args.estimators), "estimators", "one or more", args.estimators)
    integer("repeats", args.repeats, 1, 1000)
    measured = read_field(args.source, args.segments, args.lanes, args.speed_limit)
    integer("window", args.window, 61, len(measured.density) - 1)
    road = {"corridor": field_corridor(measured, args.lanes, args.speed_limit)}
    given = args.keywords()
    try:
        with quietly():
            replays = {
                name: Replay(
                    measured,
                    make_config(ENV, {**given, **road, "estimator": name}),
                    args.window,
                    args.repeats,
                )
                for name in args.estimators
            }
    except ValueError as problem:
        if str(problem).startswith("corridor.segment_length"):
            raise ValueError(f"segments must be fewer, got {args.segments}: {problem}") from problem
        raise
    noise = next(iter(replays.values())).sigma
    scores = {name: replay.run() for name, replay in replays.items()}
    if args.json:
        print(json.dumps({name: score._asdict() for name, score in scores.items()}, indent=2))
        return
    density, speed = noise
    table = make_table(
        f"noise: {density:.1f} veh/km, {speed:.1f} km/h",
        "estimator", "error x 1000", "density [veh/km]", "speed [km/h]", "chi2 density",
        "chi2 speed",
    )  # fmt: skip
    for name, score in scores.items():
        table.add_row(LABELS.get(name, name), *(f"{value:.2f}" for value in score))
    print_table(table)
