"""Units of a file of trajectories, recognised from its points where they are certain."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import polars as pl

from dptse_env.importers.source import LENGTHS, SPEEDS, TIMES, UNITS, Source, TrajectoryError

SAMPLE = 100_000
"""Rows at the start of a file by which units are recognised."""
FRAME_RATES = (5.0, 10.0, 12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 50.0, 60.0)
"""Usual frames a second."""
TOLERANCE = 1.25
"""Largest factor between speeds and what positions say of them."""
SLOWEST_ROAD, FASTEST_ROAD = 1.0, 250.0
"""Usual speeds [km/h] of the vehicles that move furthest, beyond which a unit is wrong."""
LONGEST_STEP = 10.0
"""Time between two points of a vehicle [s] beyond which a unit is wrong."""
SURE_TOLERANCE, SURE_SPEEDS, SURE_STEPS = 1.05, (10.0, 150.0), (0.02, 2.0)
"""The same for a unit that nobody gave."""
LEAST_EXTENT = 0.75
"""Share of the road that points cover in such a unit."""


class Motion(NamedTuple):
    """Motion of the vehicles of a file, in the units that are assumed.

    Attributes:
        step: Usual time between two points of a vehicle [s].
        speed: Usual speed from positions, of the vehicles that move furthest [km/h].
        ratio: Usual ratio of given speeds to it; None without speeds.
        in_frames: Whether times may be numbers of frames.
        extent: Length over which positions spread, over that of the road; None where positions do
            not tell it.
    """

    step: float
    speed: float
    ratio: float | None
    in_frames: bool
    extent: float | None

    def fits(self, time: float, length: float, speed: float) -> bool:
        """Return whether it is certain in units larger than the assumed ones by some factors."""
        return (
            SURE_STEPS[0] <= self.step * time <= SURE_STEPS[1]
            and SURE_SPEEDS[0] <= self.speed * length / time <= SURE_SPEEDS[1]
            and (self.extent is None or self.extent * length >= LEAST_EXTENT)
            and (
                self.ratio is None
                or 1.0 / SURE_TOLERANCE <= self.ratio * speed * time / length <= SURE_TOLERANCE
            )
        )

    @property
    def is_usual(self) -> bool:
        """True if nothing tells that an assumed unit is wrong."""
        ratio = 1.0 if self.ratio is None else self.ratio
        slowest = SURE_SPEEDS[0] if self.ratio is None else SLOWEST_ROAD
        return (
            self.step <= LONGEST_STEP
            and slowest <= self.speed <= FASTEST_ROAD
            and 1.0 / TOLERANCE <= ratio <= TOLERANCE
        )


def motion(
    points: pl.DataFrame, source: Source, time_unit: float, road_length: float
) -> Motion | None:
    """Return how vehicles move; None where no vehicle has two points.

    Args:
        points: Some points, as `dptse_env.importers.tables.scan` gives them.
        source: What the file means.
        time_unit: The assumed unit of time [s].
        road_length: Length of the road [km].
    """
    c = pl.col
    key = ("group", "vehicle", "edge")
    move = c("x").diff().over(key)
    if source.layout.centre_line:
        move = (move**2 + c("y").diff().over(key) ** 2).sqrt()
    steps = (
        points.filter(c("vehicle").is_not_null(), c("time").is_finite(), c("x").is_finite())
        .sort(*key, "time")
        .with_columns(
            wait=c("time").diff().over(key), move=move.abs(),
            driven=(c("speed") + c("speed").shift().over(key)).abs() / 2,
        )
        # Not those of ids that several vehicles share.
        .filter((c("wait") != 0.0).all().over(key), c("wait") > 0.0)
    )  # fmt: skip
    steps = steps.filter(c("wait") <= 3.0 * c("wait").median())
    vehicles = (
        steps.group_by(key)
        .agg(c("wait").sum(), c("move").sum(), driven=(c("driven") * c("wait")).sum(),
             has_speed=c("speed").is_finite().fill_null(False).all())
        .filter((c("move") > 0.0) & (c("move") >= c("move").median()))
    )  # fmt: skip
    if vehicles.is_empty():
        return None
    waits, moves, driven = (vehicles[name].to_numpy() for name in ("wait", "move", "driven"))
    numbers = points["time"].drop_nulls().to_numpy() / time_unit
    step = float(np.median(steps["wait"].to_numpy()))
    by_place = not source.layout.centre_line and points["edge"].null_count() == len(points)
    ends = np.quantile(points["x"].drop_nulls().drop_nans().to_numpy(), [0.01, 0.99])
    return Motion(
        step,
        float(np.median(3600.0 * moves / waits)),
        float(np.median(driven / moves / 3600.0)) if vehicles["has_speed"].all() else None,
        bool(abs(step / time_unit - 1.0) < 1e-6 and np.all(numbers == np.round(numbers))),
        float(ends[1] - ends[0]) / road_length if by_place else None,
    )


def recognised(moves: Motion, source: Source, assumed: Mapping[str, str]) -> list[Source]:
    """Return what a file may mean if the assumed units are wrong, the fewest units changed.

    Args:
        moves: How its vehicles move in the assumed units.
        source: What was said of the file; units in it are not changed.
        assumed: Its unit by quantity.
    """
    free = [name for name in UNITS if name not in source.units]
    found: dict[int, list[Source]] = {}
    for times, length, speed in itertools.product(
        _times(source, assumed, moves) if "time" in free else [(assumed["time"], 1.0, None)],
        LENGTHS if "length" in free else [assumed["length"]],
        SPEEDS if "speed" in free and moves.ratio is not None else [assumed["speed"]],
    ):
        time, time_factor, rate = times
        units = {"time": time, "length": length, "speed": speed}
        factors = (LENGTHS[length] / LENGTHS[assumed["length"]],
                   SPEEDS[speed] / SPEEDS[assumed["speed"]])  # fmt: skip
        if moves.fits(time_factor, *factors):
            changed = {name: unit for name, unit in units.items() if unit != assumed[name]}
            new = dataclasses.replace(
                source, units=source.units | changed, frame_rate=rate or source.frame_rate
            )
            found.setdefault(len(changed), []).append(new)
    return found[min(found)] if found else []


def _times(
    source: Source, assumed: Mapping[str, str], moves: Motion
) -> Iterator[tuple[str, float, float | None]]:
    """Yield units of time, their size in the assumed one, and frames a second if they are that."""
    unit = source.factor("time", assumed["time"])
    for name, size in TIMES.items():
        if name != "frame":
            yield name, size / unit, None
    if moves.in_frames:
        for rate in FRAME_RATES:
            yield "frame", 1.0 / rate / unit, rate


def choose(
    points: pl.DataFrame, source: Source, assumed: Mapping[str, str], road_length: float, where: str
) -> Source:
    """Return a source with the units that its points have, where these are certain.

    Units that fit are kept, and so are all where none that is known fits: later checks say what is
    wrong with them.

    Raises:
        TrajectoryError: Several other units fit.
    """
    moves = motion(points, source, source.factor("time", assumed["time"]), road_length)
    if moves is None or moves.is_usual:
        return source
    found = recognised(moves, source, assumed)
    if len(found) > 1:
        words = " or ".join(in_words(each, source) for each in found)
        raise TrajectoryError(
            f"{where}: units must be given, likely {words}: with {stated(assumed)} points of a "
            f"vehicle are {moves.step:.4g} s apart and vehicles drive {moves.speed:.4g} km/h"
        )
    return found[0] if found else source


def stated(units: Mapping[str, str]) -> str:
    """Describe units."""
    return ", ".join(f"{name} in {units[name]}" for name in UNITS)


def in_words(source: Source, base: Source) -> str:
    """Describe the units that were changed, as they are given."""
    changed = [
        f"units.{name} = {unit!r}"
        for name, unit in source.units.items()
        if base.units.get(name) != unit
    ]
    if source.frame_rate != base.frame_rate:
        changed.append(f"frame_rate = {source.frame_rate:g}")
    return ", ".join(changed)
