"""Check of a file's units against the motion of its vehicles."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from dptse_env.importers.source import LENGTHS, SPEEDS, TIMES, UNITS, Source, TrajectoryError
from dptse_env.utils.units import HOUR

SAMPLE = 100_000
"""Rows at the start of a file by which units are checked before points are placed."""
LONGEST_STEP = 10.0
"""Time between two points of a vehicle [s] beyond which a unit is wrong."""
SLOWEST, FASTEST = 1.0, 250.0
"""Usual speeds [km/h] of the vehicles that move furthest, beyond which a unit is wrong."""
TOLERANCE = 1.25
"""Largest factor between speeds and what positions say of them."""
LIKELY_STEPS, LIKELY_SPEEDS, LIKELY_TOLERANCE = (0.02, 2.0), (10.0, 150.0), 1.05
"""The same in units that are proposed."""
FRAME_RATES = (5.0, 60.0)
"""Usual frames a second."""


class Motion(NamedTuple):
    """Motion of the vehicles of a file in its units.

    Attributes:
        step: Usual time between two points of a vehicle [s].
        speed: Usual speed from positions, of the vehicles that move furthest [km/h].
        ratio: Usual ratio of given speeds to it; None without speeds.
        counts: Whether times are whole numbers that a point of a vehicle counts on by one.
    """

    step: float
    speed: float
    ratio: float | None = None
    counts: bool = False

    def is_usual(self, slowest: float = SLOWEST) -> bool:
        """Return whether nothing tells that a unit is wrong."""
        ratio = 1.0 if self.ratio is None else self.ratio
        return (
            self.step <= LONGEST_STEP
            and slowest <= self.speed <= FASTEST
            and 1.0 / TOLERANCE <= ratio <= TOLERANCE
        )

    def fits(self, time: float, length: float, speed: float) -> bool:
        """Return whether it is likely in units larger by some factors."""
        ratio = 1.0 if self.ratio is None else self.ratio * speed * time / length
        return (
            LIKELY_STEPS[0] <= self.step * time <= LIKELY_STEPS[1]
            and LIKELY_SPEEDS[0] <= self.speed * length / time <= LIKELY_SPEEDS[1]
            and 1.0 / LIKELY_TOLERANCE <= ratio <= LIKELY_TOLERANCE
        )

    def __str__(self) -> str:
        """Describe it."""
        ratio = "" if self.ratio is None else f", at {self.ratio:.4g} times this speed as given"
        return (
            f"points of a vehicle are {self.step:.4g} s apart, and vehicles drive "
            f"{self.speed:.4g} km/h by positions{ratio}"
        )


def motion(points: pl.DataFrame, source: Source, time_unit: float) -> Motion | None:
    """Return how vehicles move; None where no vehicle has two points.

    Args:
        points: Some points, as `dptse_env.importers.tables.scan` gives them.
        source: What the file means.
        time_unit: Its unit of time [s].
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
    return Motion(
        step,
        float(np.median(HOUR * moves / waits)),
        float(np.median(driven / moves / HOUR)) if vehicles["has_speed"].all() else None,
        bool(abs(step / time_unit - 1.0) < 1e-6 and np.all(numbers == np.round(numbers))),
    )


def check_units(
    moves: Motion, source: Source, units: Mapping[str, str], where: str, *, whole: bool
) -> None:
    """Refuse a file whose vehicles move as none do, unless its units are given.

    Args:
        moves: How its vehicles move.
        source: What was said of the file.
        units: Its unit by quantity.
        where: The file, for messages.
        whole: Whether all of the file was looked at; else it is refused only if other units fit.

    Raises:
        TrajectoryError: They do, and a unit is not given; the message has the units that fit.

    Warns:
        UserWarning: They do, and all units are given.
    """
    if moves.is_usual(SLOWEST if whole else LIKELY_SPEEDS[0]):
        return
    quantities = ("time", "length") if moves.ratio is None else tuple(UNITS)
    likely, given = _likely(moves, source, units), set(quantities) <= set(source.units)
    if likely or whole:
        odd_unit(where, "units", stated(units), given, likely, str(moves))


def odd_unit(
    where: str, name: str, unit: str, given: bool, likely: Sequence[str], problem: str
) -> None:
    """Refuse data with a `problem` in a unit that nobody gave, and name `likely` ones.

    Raises:
        TrajectoryError: Nobody gave the unit of the field `name`.

    Warns:
        UserWarning: It was given, and is kept.
    """
    if given:
        warnings.warn(f"{where}: {name}, as given: {unit}; is that right? {problem}", stacklevel=5)
        return
    raise TrajectoryError(
        f"{where}: {name} must fit the data, likely {' or '.join(likely) or 'none that is known'}, "
        f"got {unit}: {problem}; a unit that is given is kept"
    )


def _likely(moves: Motion, source: Source, units: Mapping[str, str]) -> list[str]:
    """Return other units that would fit, the fewest changed, as they are given to a source."""
    found: dict[int, list[str]] = {}
    choices = [
        [units[quantity]] if quantity in source.units or (quantity == "speed" and not moves.ratio)
        else [unit for unit in known if unit != "frame"]
        for quantity, known in UNITS.items()
    ]  # fmt: skip
    for time, length, speed in itertools.product(*choices):
        factors = (
            TIMES[time] / source.factor("time", units["time"]) if time != units["time"] else 1.0,
            LENGTHS[length] / LENGTHS[units["length"]],
            SPEEDS[speed] / SPEEDS[units["speed"]],
        )
        changed = {
            quantity: unit
            for quantity, unit in zip(UNITS, (time, length, speed), strict=True)
            if unit != units[quantity]
        }
        if moves.fits(*factors):
            words = ", ".join(f"units.{name} = {unit!r}" for name, unit in changed.items())
            found.setdefault(len(changed), []).append(words)
    likely = found[min(found)] if found else []
    slowest, fastest = (moves.speed * source.factor("time", units["time"]) * rate
                        for rate in FRAME_RATES)  # fmt: skip
    if moves.counts and fastest >= LIKELY_SPEEDS[0] and slowest <= LIKELY_SPEEDS[1]:
        likely.append("units.time = 'frame' and frame_rate, the frames a second")
    return likely


def stated(units: Mapping[str, str]) -> str:
    """Describe units."""
    return ", ".join(f"{name} in {units[name]}" for name in UNITS)
