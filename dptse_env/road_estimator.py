"""An estimator on a road, with whatever its sensors say: a door for a stream of one's own.

A reading of a station counts in the middle of its interval, and what other sources say in every
second of theirs. The estimator keeps some of its past states. It goes back to the beginning of an
interval and forward again, so that readings of a second or of ten minutes, in time or late, are one
case. Sources of the same second and segment are put together by their variances. What nobody saw is
as predicted.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from dptse_env.config import resolve
from dptse_env.estimators import Estimate, Measurement, make_estimator
from dptse_env.measurement import nominal_state
from dptse_env.measurement.boundary import nominal_inputs
from dptse_env.measurement.loops import UNKNOWN, interpreted, seconds_told
from dptse_env.measurement.seen import LONGEST, Seen
from dptse_env.parts import make_model
from dptse_env.traffic.loops import TOLERANCE, borders_of
from dptse_env.utils.arrays import AnyArray, FloatArray, IntArray
from dptse_env.utils.files import dump_tensors, json_digest, parse_tensors, require_arrays
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.validation import convert, integer, require, within
from dptse_env.versions import code_version, numbers_of

FORMAT = "road-estimator-1"
"""Name of the layout of a saved state; another one is refused."""
LARGEST_STATE = 2**30
"""Largest size of a saved state [bytes]."""

SPACING = 8
"""The state of second t is kept for this many times the largest power of two in t, so that to go
back costs an eighth of the way at most."""
N_ROWS = 768
"""Seconds of the stream that are kept. States that are gone back to are 727 s old at most."""
LATEST = 2**40
"""Largest second of a clock, and minus the smallest one."""

_ONE = np.array([0])
_NO_QUERIES = {
    "privacy": "corrected", "epsilon": 5.0, "penetration": 1.0, "sensor_settings": {},
    "query_spans": (1,), "bandwidth": 1,
}  # fmt: skip
"""Keywords that a road file may have for queries, which nobody asks here."""


class Additions(NamedTuple):
    """Additions of sources to K places of the stream."""

    seconds: IntArray  # (K,)
    # (K,) segments, and boundary segments beside them where a source knows both quantities
    cells: IntArray
    added: FloatArray  # (K, 2, 2) weights 1 / std^2 and weighted values of both quantities

    def unchanged(self, second: int) -> int:
        """Return the last second up to one that they leave as it was."""
        return min(second, int(self.seconds.min(initial=second + 1)) - 1)


_NOTHING = Additions(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2, 2)))


class RoadEstimator:
    """An estimator on a road, second by second, from whatever came in.

    At the ends of the road and of its ramps there is the traffic that sources beside them said
    last, within ten minutes. Where none did, vehicles enter at the demand of the road file, which
    begins with the stream, and whose last value goes on. Behind an exit that nobody sees, traffic
    is as before it.

    Attributes:
        corridor: The road.
        model: Its traffic model.
        time: The present second.
    """

    def __init__(
        self,
        road: Any,
        estimator: Any = "recurrent",
        *,
        stations: Sequence[float] | None = None,
        start: int = 0,
        parameters: Any = None,
        estimator_settings: Any = None,
    ) -> None:
        """Begin with free traffic, at the demand that the road file publishes.

        Args:
            road: A road file, the name of a road, or a `Corridor`.
            estimator: See the keyword of an environment.
            stations: Places of stations on the mainline [km], increasing; None for the loops of the
                road. Where neither caller nor road file give settings, `asm` smooths over half of
                their mean distance, over 0.1 to 1 km.
            start: The present second, on the clock of the stream.
            parameters: See the keyword of an environment.
            estimator_settings: See the keyword of an environment.

        Raises:
            ValueError: A value is out of range, or the estimator does not say what it remembers.

        Warns:
            UserWarning: Values that were measured or tuned on other roads are used.
        """
        given = {"parameters": parameters, "estimator_settings": estimator_settings}
        given = {name: value for name, value in given.items() if value is not None}
        keywords = {**_NO_QUERIES, "corridor": road, "estimator": estimator, **given}
        config = resolve("private-highway", keywords)
        self.corridor, self.model = config.corridor, make_model(config)
        geometry = self.corridor.geometry
        # The mainline (None) and each ramp, by face: its first segment, its borders [km].
        self._borders: dict[int | None, tuple[int, FloatArray]] = {None: (0, borders_of(geometry))}
        for face, _, segments in geometry.ramps():
            self._borders[face] = segments[0], borders_of(geometry, segments)
        settings, distance = config.settings(), self._distance(stations)
        if distance > 0.0 and config.estimator_settings is None and hasattr(settings, "asm"):
            own = dataclasses.replace(settings.asm, length=min(max(0.5 * distance, 0.1), 1.0))
            settings = dataclasses.replace(settings, asm=own)
        self._estimator = make_estimator(estimator, "compiled", self.model, 1, settings)
        self.time = self._start = integer("start", start, -LATEST, LATEST)
        self._made_of = {
            "format": FORMAT,
            "version": numbers_of(code_version()),
            "road": json_digest([repr(self.corridor.geometry), self.corridor.digest]),
            "estimator": name_of_class(type(self._estimator)),
            "settings": json_digest([repr(settings), repr(config.parameters)]),
        }
        self._demand = nominal_inputs(self.corridor, self.model)
        # What was said last beside the R boundary segments: density, speed, second; never yet.
        self._ends = np.zeros((1, self.model.n_boundaries, 3))
        self._ends[..., 2] = -np.finfo(float).max
        self._stream = np.zeros((N_ROWS, self.corridor.geometry.n_cells, 2, 2))
        prior = nominal_state(self.corridor, self.model, np.array([0]))
        self._estimator.reset(_ONE, prior, [np.random.default_rng(0)])
        self._kept = {self.time: self._packed()}
        self._estimates = {self.time: self._estimator.estimate()}

    def step(self, seen: Iterable[Seen] = (), seconds: int = 1) -> None:
        """Go on, and take what came in.

        Args:
            seen: What sources said: results of `station`, `probes` and `Seen`.
            seconds: Seconds to go on by, of which a gap has many.

        Raises:
            ValueError: A place is not on the road, a station says two things of one interval, or an
                interval ended more than ten minutes ago, ends in the future, or ended before the
                stream began. Nothing has changed then, nor after any other exception, Ctrl-C among
                them.

        Warns:
            UserWarning: A point lies within a segment and counts at its border.
        """
        now = self.time + integer("seconds", seconds, 1, 10**7)
        allowed = "a sequence of what station() and others return"
        require(isinstance(seen, Iterable), "seen", allowed, seen)
        seen = list(seen)
        additions = self._additions(seen, now) if seen else _NOTHING
        unchanged = max(additions.unchanged(self.time), now - N_ROWS)
        with self._whole(range(unchanged + 1, now + 1)):
            while now - self.time > LONGEST:
                self._go_on(self.time + LONGEST)
            self._go_on(now, additions)

    def estimate(self, delay: int = 0) -> Estimate:
        """Return density [veh/km] and speed [km/h] of every segment, and deviations, (S,) each.

        Args:
            delay: Seconds before the present, for an estimate of then by what is known now.

        Raises:
            ValueError: It is longer than ten minutes, or than the stream.
        """
        longest = min(LONGEST, self.time - self._start)
        found = self._estimates[self.time - integer("delay", delay, 0, longest)]
        return Estimate(*(array[0].copy() for array in found))

    def save(self) -> bytes:
        """Return the oldest state that is kept, and the stream since, for `load`."""
        first = min(self._kept)
        since = np.arange(first + 1, self.time + 1) % N_ROWS
        # As bytes, so that NaN and flags can be stored, too.
        arrays = {"memory": self._kept[first], "stream": self._stream[since].view(np.uint8)}
        times = {"start": self._start, "first": first, "time": self.time}
        return dump_tensors(arrays, {**self._made_of, **times}, "state", LARGEST_STATE)

    def load(self, state: bytes) -> None:
        """Go on where another one, made alike, was saved, with the same bits.

        A digest finds damage, not forgery, which may be as wrong as it likes within the ranges of
        numbers: load states that you trust alone.

        Raises:
            ValueError: It is damaged, or of another road, estimator, setting or version. Nothing
                has changed then, nor after any other exception.
        """
        require(isinstance(state, bytes), "state", "the bytes that save() returned", state)
        card, arrays = parse_tensors(state, "state")
        for name, value in self._made_of.items():
            require(card.get(name) == value, f"state.{name}", repr(value), card.get(name))
        start, first, now = (
            integer(f"state.{name}", card.get(name), -LATEST, LATEST)
            for name in ("start", "first", "time")
        )
        is_stream = start <= first <= now < first + N_ROWS
        require(is_stream, "state.time", "one of a stream", now)
        n_rows, row = now - first, self._stream[0].view(np.uint8).shape
        shapes = {"memory": self._packed().shape, "stream": (n_rows, *row)}
        with within("state: "), self._whole(range(N_ROWS)):
            require_arrays(arrays, shapes, np.uint8)
            self._start, self.time = start, first
            self._kept = {first: arrays["memory"]}
            self._stream[np.arange(first + 1, now + 1) % N_ROWS] = arrays["stream"].view(np.float64)
            self._restore(first)
            self._estimator.check_memory()
            for name, array in (("ends", self._ends), ("stream", self._stream)):
                wrong = array[~np.isfinite(array)].tolist()
                require(not wrong, name, "finite", wrong[:1])
            self._estimates = {first: self._estimator.estimate()}
            self._run(first, now)
            self._estimator.check_estimate(self._estimates[now])

    @contextmanager
    def _whole(self, seconds: range) -> Iterator[None]:
        """Leave all as it was where the body, which changes those of the stream, does not end."""
        before = self._start, self.time
        kept, estimates = dict(self._kept), dict(self._estimates)
        rows = np.array(seconds) % N_ROWS
        stream = self._stream[rows]
        try:
            yield
        except BaseException:
            self._start, self.time = before
            self._kept, self._estimates = kept, estimates
            self._stream[rows] = stream
            self._restore(self.time)
            raise

    def _additions(self, seen: Sequence[Any], now: int) -> Additions:
        """Return what sources add to the stream at second `now`, or refuse them."""
        oldest = max(now - LONGEST, self._start) + 1
        seconds, segments, told, stations = [], [], [], set[tuple[Any, ...]]()
        for i, each in enumerate(seen):
            path, allowed = f"seen[{i}]", "what station(), probes() or Seen() returns"
            require(isinstance(each, Seen), path, allowed, each)
            until, allowed = now if each.until is None else each.until, f"in {oldest}..{now}"
            in_time = oldest <= until <= now
            require(in_time, f"{path}.until", f"{allowed}, which can still change", until)
            segments.append(self._segments(path, each))
            n = each.seconds
            if each.flow is not None:
                reading = each.start, each.ramp, n, until
                allowed = "the only reading of its station and interval: add up those of lanes"
                require(reading not in stations, path, allowed, f"another one at {each.start:g} km")
                stations.add(reading)
            counts = until - n + 1 + (np.arange(n) if each.flow is None else seconds_told(n))
            seconds.append(counts[counts >= oldest])
            fields = each.density, each.speed, each.density_std, each.speed_std, each.flow
            told.append((*fields, n, counts.size))
        place, n_segments = np.concatenate(segments), [*map(len, segments)]
        source = np.arange(len(seen)).repeat(n_segments)
        added = self._weighted(np.array(told, np.float64)[source], place)
        # Cells: the segments, and boundary segments where both quantities are known beside them.
        own, end = np.nonzero(place[:, None] == self.corridor.road.beside)
        knows_both = added[own, :, 0].all(axis=1)
        cell = np.concatenate([place, self.model.n_segments + end[knows_both]])
        index = np.concatenate([np.arange(place.size), own[knows_both]])
        own_seconds = [seconds[i] for i in source[index].tolist()]
        times = [*map(len, own_seconds)]
        return Additions(
            np.concatenate(own_seconds), cell.repeat(times), added[index.repeat(times)]
        )

    def _weighted(self, told: FloatArray, segments: IntArray) -> FloatArray:
        """Return weights and weighted values of what K segments are told, (K, 2, 2).

        Args:
            told: Density, speed, their deviations, flow, seconds, and in how many of these it
                counts, (K, 7), NaN for none.
            segments: Shape (K,).
        """
        road, (*values, flow, seconds, times) = self.corridor.road, told.T
        said = interpreted(
            flow, values[1], seconds, road.lanes[segments], road.lengths[segments],
            road.limits[segments], segments >= road.n_mainline,
        )  # fmt: skip
        found = np.where(np.isnan(flow), values, said[:4])
        # An interval counts once, since its errors are alike.
        weights = np.nan_to_num(1.0 / (times * found[2:] ** 2))
        return np.stack([weights, weights * np.nan_to_num(found[:2])], axis=-1).swapaxes(0, 1)

    def _segments(self, path: str, each: Seen) -> IntArray:
        """Return the segments that a source says something of."""
        faces = [face for face in self._borders if face is not None]
        allowed = f"None or the face of a ramp, {faces}"
        require(each.ramp in self._borders, f"{path}.ramp", allowed, each.ramp)
        first, borders = self._borders[each.ramp]
        is_there, allowed = each.end <= borders[-1] + TOLERANCE, f"in 0..{borders[-1]:g} km"
        require(is_there, f"{path}.end", allowed, each.end)
        n, middle = len(borders) - 1, 0.5 * (each.start + each.end) + TOLERANCE
        there = min(int(np.searchsorted(borders, middle, "right")) - 1, n - 1)
        if each.start < each.end:
            middles = 0.5 * (borders[:-1] + borders[1:])
            low, high = np.searchsorted(middles, [each.start, each.end]).tolist()
            return first + (np.arange(low, high) if low < high else np.array([there]))
        face = int(np.abs(borders - each.start).argmin())
        if each.ramp is None and face in self._borders:  # a ramp changes the traffic there
            return np.arange(there, there + 1)
        if abs(borders[face] - each.start) > TOLERANCE:
            text = f"{each.start:g} km lies within a segment, and counts at its border at"
            warnings.warn(f"{text} {borders[face]:g} km", UserWarning, stacklevel=1)
        low, high = max(face - 1, 0), min(face + 1, n)
        return np.arange(first + low, first + high)

    def _go_on(self, now: int, additions: Additions = _NOTHING) -> None:
        """Go on to second `now`, from before what has changed."""
        self._stream[np.arange(self.time + 1, now + 1) % N_ROWS] = 0.0
        seconds, cells, added = additions
        np.add.at(self._stream, (seconds % N_ROWS, cells), added)  # a cell may be there twice
        unchanged = additions.unchanged(self.time)
        back = max(second for second in self._kept if second <= unchanged)
        if back < self.time:
            self._restore(back)
        self._run(back, now)

    def _run(self, back: int, now: int) -> None:
        """Go on from second `back`, whose state it is in, to second `now`."""
        for second in range(back + 1, now + 1):
            self._advance(second)
            if now - second <= SPACING * (second & -second):
                self._kept[second] = self._packed()
        self.time = now
        gone = [second for second in self._kept if second <= now - LONGEST]
        first = max(gone, default=min(self._kept))
        self._kept = {
            second: state
            for second, state in self._kept.items()
            if second == first or (second > first and now - second <= SPACING * (second & -second))
        }
        self._estimates = {t: found for t, found in self._estimates.items() if t >= first}

    def _advance(self, second: int) -> None:
        """Go on by one second, by what was seen in it."""
        weights, totals = np.moveaxis(self._stream[second % N_ROWS], -1, 0)
        known = weights > 0.0
        values, S = totals / np.where(known, weights, 1.0), self.model.n_segments
        at_ends = known[S:].all(axis=-1)
        self._ends[0, at_ends, :2], self._ends[0, at_ends, 2] = values[S:][at_ends], second
        self._estimator.predict(_ONE, self._inputs(second))
        weights, known, values = weights[:S], known[:S], values[:S]
        if not known.all():
            x = self._estimator.estimate()
            values = np.where(known, values, np.stack([x.density[0], x.speed[0]], axis=-1))
        sigma, seen = np.where(known, weights, UNKNOWN**-2) ** -0.5, known.any(axis=-1)
        measured = Measurement.of(self.model, seen[None], values[None], sigma[None])
        self._estimator.update(_ONE, measured)
        self._estimates[second] = self._estimator.estimate()

    def _inputs(self, second: int) -> FloatArray:
        """Return the model's inputs (1, n_u) of a second."""
        road, before, ends = self.corridor.road, self._estimates[second - 1], self._ends[0]
        fresh = second - ends[:, 2] <= LONGEST
        density = np.where(fresh, ends[:, 0], before.density[:, road.beside])
        speed = np.where(fresh, ends[:, 1], before.speed[:, road.beside])
        inputs = self.model.boundary_inputs(density, speed)
        elapsed = min(second - 1 - self._start, len(self._demand) - 1)
        unseen = road.entry_inputs[~fresh[road.entry_cells - road.n_segments]]
        for column in (unseen, unseen + 1):  # demand, and w
            inputs[0, column] = self._demand[elapsed, column]
        return inputs

    def _packed(self) -> AnyArray:
        """Return the bytes of the present state."""
        arrays = *self._estimator.memory, self._ends
        return np.concatenate([array.ravel().view(np.uint8) for array in arrays])

    def _restore(self, second: int) -> None:
        """Go back to the state of a second, and forget later ones."""
        self._kept = {t: state for t, state in self._kept.items() if t <= second}
        begin, state = 0, self._kept[second]
        for array in (*self._estimator.memory, self._ends):
            own = state[begin : begin + array.nbytes]
            array[...] = own.view(array.dtype).reshape(array.shape)
            begin += array.nbytes

    def _distance(self, stations: Sequence[float] | None) -> float:
        """Return the mean distance of stations [km], 0 where there are no two of them."""
        loops, length = self.corridor.loops, self._borders[None][1][-1]
        if stations is None:
            stations = () if loops is None else loops.positions
        places = convert(tuple[float, ...], stations, "stations")
        allowed = f"increasing places in 0..{length:g} km"
        fits = list(places) == sorted(set(places)) and all(0.0 <= x <= length for x in places)
        require(fits, "stations", allowed, places)
        return (places[-1] - places[0]) / (len(places) - 1) if len(places) > 1 else 0.0
