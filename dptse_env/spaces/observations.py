"""The observation: the operator's knowledge as a flat float32 vector.

It consists of named blocks, each with fixed bounds and scaled by physical constants of the
corridor, so there are no running statistics that could be lost between training and use. It has
released values, the estimator's output, the query history and public settings, but neither the
truth, nor a clock, nor anything that distinguishes an empty segment from an occupied one; except
for loops, whose readings are public, and come at the ends of intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import numpy as np
from gymnasium import spaces

from dptse_env.estimators import Estimate
from dptse_env.release import Task
from dptse_env.traffic.loops import borders_of
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.registry import Registry, is_foreign, missing_methods, name_of_class
from dptse_env.utils.validation import require

AGE_CAP = 60
"""Largest age of a segment [s] that observations distinguish."""

PRICE_UNIT = 2.0
"""Unit of the logarithm of prices that makes observations of them of order one."""

NOT_REPORTED = -1
"""Flow or speed of a loop that has not reported any."""

DEFAULT = "default"
"""Name that stands for all default blocks."""


class PublicState(NamedTuple):
    """The operator's knowledge about k episodes, in physical units; the truth is no part of it.

    Attributes:
        estimate: Densities [veh/km], speeds [km/h] and their standard deviations, each (k, S).
        released: Last released (density [veh/km], speed [km/h] or flow [veh/h]) per row, the
            queries first, shape (k, M, 2); zero before the first release.
        innovations: Normalised innovations of the last update, shape (k, M, 2); zero where
            nothing was observed.
        age: Steps since each mainline segment was last observed, shape (k, n_mainline).
        queried: The queries that were last queried, shape (k, G).
        picked: Queries picked so far for the next query, shape (k, G).
        prices: Price of the last query of each query, shape (k, G); zero where there was none.
            None where queries have no prices.
        spent_share: The release model's public account of what a vehicle on each mainline segment
            has been charged on average, over its budget, in [0, 1], shape (k, n_mainline). None
            where queries have no prices.
        readings: What each of the F stations of loops reported last, the flow [veh/h] and the mean
            speed [km/h], NaN where it is not known, shape (k, F, 2). None where there are no loops.
        reading_age: Intervals since that of these readings ended, below 1, shape (k,).
    """

    estimate: Estimate
    released: FloatArray
    innovations: FloatArray
    age: IntArray
    queried: BoolArray
    picked: BoolArray
    prices: FloatArray | None = None
    spent_share: FloatArray | None = None
    readings: FloatArray | None = None
    reading_age: FloatArray | None = None


class ObservationBlock(Protocol):
    """A named part of the observation; classes of blocks take no arguments.

    Attributes:
        name: Name, different from those of the blocks that ship with the package.
        low: Lower bound; values below are clipped.
        high: Upper bound; values above are clipped.
    """

    name: str
    low: float
    high: float

    def size(self, task: Task) -> int:
        """Return the number of values."""

    def values(self, state: PublicState, task: Task) -> AnyArray | float:
        """Return finite values of k episodes, shape (k, size), or one number for all of them."""


Transform = Callable[[FloatArray, float], FloatArray]
"""Function of values and their unit."""


@dataclass(frozen=True)
class Block:
    """A block that ships with the package: a field of the public state, or a constant, in a unit.

    Attributes:
        name: Name.
        size: Number of values.
        low: Lower bound; values below are clipped.
        high: Upper bound; values above are clipped.
        field: Attribute of `PublicState`, such as ``"estimate.speed"``; empty for a constant.
        unit: Unit of the values.
        part: Index into the field; None for all of it.
        constant: The value, or values, where there is no field, or while it is None.
        transform: Makes values of the field and the unit, in place of their quotient.
        is_default: Whether the default observation has it, by the task and by whether actions pick
            one by one.
    """

    name: str
    size: Callable[[Task], int]
    low: float
    high: float
    field: str
    unit: Callable[[Task], float] = lambda task: 1.0
    part: Callable[[Task], Any] | None = None
    constant: Callable[[Task], float | FloatArray] = lambda task: 0.0
    transform: Transform | None = None
    is_default: Callable[[Task, bool], bool] = lambda task, one_by_one: True

    def __reduce__(self) -> tuple[Callable[[str], Block], tuple[str]]:
        """Pickle as the name, since lambda functions cannot be pickled."""
        return _shipped_block, (self.name,)


_TINY = np.finfo(np.float64).tiny


def _segments(task: Task) -> int:
    return task.corridor.geometry.n_segments


def _mainline(task: Task) -> int:
    return task.corridor.geometry.n_mainline


def _queries(task: Task) -> int:
    return task.queries.n_queries


def _fixed(task: Task) -> int:
    return len(task.corridor.fixed_sensors)


def _density_scale(task: Task) -> float:
    return task.corridor.scales.density_scale


def _speed_scale(task: Task) -> float:
    return task.corridor.scales.speed_scale


def _flow_scale(task: Task) -> float:
    return task.corridor.scales.density_scale * task.corridor.scales.speed_scale


def _of_queries(component: int) -> Callable[[Task], Any]:
    return lambda task: (slice(None), slice(task.queries.n_queries), component)


def _of_sensors(component: int) -> Callable[[Task], Any]:
    return lambda task: (slice(None), task.sensors, component)


def _loops(task: Task) -> int:
    return len(task.corridor.stations.positions)


def _has_loops(task: Task, _: bool) -> bool:
    return task.corridor.loops is not None


def _places(task: Task) -> FloatArray:
    length = float(borders_of(task.corridor.geometry)[-1])
    return task.corridor.stations.positions / length


def _known(values: FloatArray, unit: float) -> FloatArray:
    return np.where(np.isfinite(values), values / unit, NOT_REPORTED)


def _log(values: FloatArray, unit: float) -> FloatArray:
    # Zero has no logarithm; that of the smallest number is clipped to the lower bound.
    return np.log(np.maximum(values / unit, _TINY))


def _log_price(prices: FloatArray, unit: float) -> FloatArray:
    return np.where(prices > 0.0, np.log10(np.maximum(prices, _TINY)), 0.0) / unit


SHIPPED_BLOCKS = (
    Block("density", _segments, 0, 4, "estimate.density", _density_scale),
    Block("speed", _segments, 0, 4, "estimate.speed", _speed_scale),
    Block("density_log_std", _segments, -10, 5, "estimate.density_std", _density_scale,
          transform=_log),
    Block("speed_log_std", _segments, -10, 5, "estimate.speed_std", _speed_scale, transform=_log),
    Block("released_density", _queries, -5, 5, "released", _density_scale, _of_queries(0)),
    Block("released_speed", _queries, -5, 5, "released", _speed_scale, _of_queries(1),
          is_default=lambda task, _: not task.releases_flow),
    Block("released_flow", _queries, -5, 5, "released", _flow_scale, _of_queries(1),
          is_default=lambda task, _: task.releases_flow),
    Block("density_innovation", _queries, -10, 10, "innovations", part=_of_queries(0)),
    Block("speed_innovation", _queries, -10, 10, "innovations", part=_of_queries(1)),
    Block("age", _mainline, 0, 1, "age", lambda _: AGE_CAP),
    Block("queried", _queries, 0, 1, "queried"),
    Block("fixed_density_innovation", _fixed, -10, 10, "innovations", part=_of_sensors(0)),
    Block("fixed_speed_innovation", _fixed, -10, 10, "innovations", part=_of_sensors(1)),
    Block("bandwidth", lambda _: 1, 0, 1, "", lambda task: task.corridor.geometry.n_mainline,
          constant=lambda task: task.queries.bandwidth),
    Block("epsilon", lambda _: 1, -6, 6, "",
          constant=lambda task: float(np.log10(task.settings.epsilon))),
    Block("picked", _queries, 0, 1, "picked", is_default=lambda _, one_by_one: one_by_one),
    Block("last_price", _queries, -5, 5, "prices", lambda _: PRICE_UNIT, transform=_log_price,
          is_default=lambda task, _: task.has_prices),
    Block("spent_share", _mainline, 0, 1, "spent_share",
          is_default=lambda task, _: task.has_prices),
    Block("loop_flow", _loops, NOT_REPORTED, 4, "readings", _flow_scale,
          lambda task: (slice(None), slice(None), 0), transform=_known, is_default=_has_loops),
    Block("loop_speed", _loops, NOT_REPORTED, 4, "readings", _speed_scale,
          lambda task: (slice(None), slice(None), 1), transform=_known, is_default=_has_loops),
    Block("loop_age", lambda _: 1, 0, 1, "reading_age", part=lambda task: (slice(None), None),
          is_default=_has_loops),
    Block("loop_position", _loops, 0, 1, "", constant=_places, is_default=_has_loops),
)  # fmt: skip
"""The shipped blocks; the default observation has those that are in it, in this order."""


def _shipped_block(name: str) -> Block:
    return next(block for block in SHIPPED_BLOCKS if block.name == name)


def _expected(part: Any) -> str | None:
    missing = missing_methods(part, ("size", "values"))
    if missing is None and not isinstance(getattr(part, "name", None), str):
        return "have a name"
    return missing


BLOCKS = Registry("observation", {block.name: block for block in SHIPPED_BLOCKS}, check=_expected)
"""Observation blocks by name."""


def default_blocks(task: Task, *, picks_one_by_one: bool = False) -> list[str]:
    """Return the names of the default blocks."""
    return [block.name for block in SHIPPED_BLOCKS if block.is_default(task, picks_one_by_one)]


class ObservationEncoding:
    """Encoding of public states as vectors, with the space and the position of every block.

    `dptse_env.env.SensorQueryEnv` has a table of the default blocks. Values beyond
    the bounds are clipped.

    Attributes:
        task: What is measured.
        space: The Gymnasium space, a float32 ``Box``.
        slices: Position of each block, by name.
    """

    def __init__(
        self, task: Task, blocks: Sequence[Any] = (DEFAULT,), *, picks_one_by_one: bool = False
    ) -> None:
        """Arrange blocks in a vector.

        Args:
            task: What is measured.
            blocks: Names, ``"package.module:Class"``, objects or classes; ``"default"`` stands for
                all default blocks.
            picks_one_by_one: Whether a decision takes several actions.

        Raises:
            ValueError: There is no such block, it lacks a method, two have the same name, or none
                has a number.
        """
        self.task = task
        defaults = default_blocks(task, picks_one_by_one=picks_one_by_one)
        names = [name for value in blocks for name in _expanded(value, defaults)]
        self.blocks: tuple[Block | ObservationBlock, ...] = tuple(map(_made, names))
        sizes = [_checked_size(block, task) for block in self.blocks]
        require(sum(sizes) > 0, "observation", "blocks that have numbers on this road", blocks)
        ends = np.cumsum(sizes).tolist()
        self.slices: dict[str, slice] = {}
        for block, size, end in zip(self.blocks, sizes, ends, strict=True):
            if block.name in self.slices:
                raise ValueError(f"observation has two blocks named {block.name!r}")
            self.slices[block.name] = slice(end - size, end)
        low = np.repeat([block.low for block in self.blocks], sizes).astype(np.float32)
        high = np.repeat([block.high for block in self.blocks], sizes).astype(np.float32)
        self.space = spaces.Box(low, high, dtype=np.float32)
        self._shipped, self._foreign, self._units = [], [], np.ones(len(low))
        self._constants = np.zeros(len(low))
        for block in self.blocks:
            place = self.slices[block.name]
            if not isinstance(block, Block):
                self._foreign.append((block, place))
                continue
            unit, part = block.unit(task), block.part and block.part(task)
            self._constants[place] = block.constant(task)
            if block.transform is None:
                self._units[place] = unit
            if block.field:
                field = attrgetter(block.field)
                self._shipped.append((place, field, part, block.transform, unit))

    def encode(self, state: PublicState) -> Observation:
        """Return the observations of k episodes, shape (k, size), always inside the space."""
        k = len(state.age)
        raw = np.empty((k, self._constants.size))
        raw[:] = self._constants
        for place, field, part, transform, unit in self._shipped:
            values: Any = field(state)
            if values is None:
                continue
            if part is not None:
                values = values[part]
            raw[:, place] = values if transform is None else transform(values, unit)
        for block, place in self._foreign:
            values = block.values(state, self.task)
            _check_values(block, values, (k, place.stop - place.start))
            raw[:, place] = values
        flat = np.empty(raw.shape, dtype=np.float32)
        np.divide(raw, self._units, out=flat, casting="same_kind")
        np.maximum(flat, self.space.low, out=flat)
        return np.minimum(flat, self.space.high, out=flat)

    def block(self, observation: Observation, name: str) -> Observation:
        """Return the block ``name`` of observations of shape (..., size).

        Raises:
            ValueError: There is no such block.
        """
        if name not in self.slices:
            raise ValueError(f"unknown observation block {name!r}; known: {', '.join(self.slices)}")
        return observation[..., self.slices[name]]


def _expanded(value: Any, defaults: list[str]) -> Sequence[Any]:
    return defaults if isinstance(value, str) and value == DEFAULT else [value]


def _made(value: Any) -> Block | ObservationBlock:
    """Return a block; one of another package must have a new name and valid bounds."""
    block = BLOCKS.find(value)
    block = block() if isinstance(block, type) else block
    if is_foreign(block):
        name = name_of_class(block)
        if block.name in {shipped.name for shipped in SHIPPED_BLOCKS}:
            raise ValueError(
                f"observation {name} must not be named {block.name!r}, which is a block of "
                "dptse_env"
            )
        low, high = getattr(block, "low", None), getattr(block, "high", None)
        numbers = isinstance(low, int | float) and isinstance(high, int | float)
        if not numbers or not block.low < block.high:
            raise ValueError(f"observation {name} must have bounds low < high, got {low}, {high}")
    made: Block | ObservationBlock = block
    return made


def _checked_size(block: Block | ObservationBlock, task: Task) -> int:
    size = block.size(task)
    if type(size) is not int or size < 0:
        raise ValueError(
            f"observation {name_of_class(block)}.size() must return an integer >= 0, got {size!r}"
        )
    return size


def _check_values(block: ObservationBlock, values: Any, shape: tuple[int, int]) -> None:
    array = np.asarray(values)
    if array.shape not in ((), shape) or array.dtype.kind not in "biuf":
        raise ValueError(
            f"observation {name_of_class(block)}.values() must return numbers of shape {shape}, "
            f"got {array.dtype} of shape {array.shape}"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"observation {name_of_class(block)}.values() must return finite numbers")
