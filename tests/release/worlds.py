"""Made-up traffic: a few vehicles on a short road, in worlds that differ in one vehicle."""

import dataclasses
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.estimators import Estimate
from dptse_env.release import RELEASE_MODELS, Group, Queries, Request, Task, Traffic
from dptse_env.release.noise import grid_of
from dptse_env.release.vehicles import Ledgers
from dptse_env.traffic import SHORT_HIGHWAY
from tests.helpers import AWAY, record, short_road

WHOLE = (Group("queries"),)
TWO_GROUPS = Group("queries", 0.7), Group("sensors", 0.3)
ONE, BOTH = np.arange(1), np.arange(2)
T, COLUMNS, SEGMENTS = 8, 12, 8
"""Seconds, record columns and segments of the short road."""

LIMIT, LENGTH = SHORT_HIGHWAY.geometry.speed_limit, SHORT_HIGHWAY.geometry.segment_length


def drives(places, speed):
    """A record of one vehicle at given segments from second 1 on."""
    places = np.concatenate([[AWAY], places])[None]
    return record(places, np.broadcast_to(speed, places.shape))


def stays(place, speed, steps=T, *, present=True):
    """A record of one vehicle that stays on a segment; second 0 is empty."""
    return drives(np.full(steps, place if present else AWAY), speed)


def crowd(n_vehicles=40, seed=0, last=COLUMNS, n_columns=COLUMNS):
    """A record of vehicles that jump about below a column, some faster than the limit."""
    generator = np.random.default_rng(seed)
    places = generator.integers(AWAY, last, (n_vehicles, T + 1))
    return record(places, generator.uniform(0.0, 1.3 * LIMIT, places.shape), n_columns)


def streams(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def task_of(model, settings, road, queries, n_episodes=1, groups=WHOLE):
    """The task of a class of release models on a road, in a batch of episodes."""
    return Task(
        settings.preset, settings, road, queries, road.conditions.duration,
        model.centre(road, settings), model.has_prices, n_episodes, groups,
    )  # fmt: skip


class Worlds:
    """Records in place of a library: traffic seed k is the k-th of them."""

    def __init__(self, *records, road=None):
        self.records = records
        self.road = road or short_road(records[0].n_steps - 1)

    def get(self, corridor, seed):
        return self.records[seed]

    def ensure(self, corridor, seeds):
        """All records are there."""

    def release(self, settings, kind=None, groups=WHOLE, bandwidth=2, spans=(1,)):
        """A release model of all record columns, of another class than the settings' if given."""
        n = len(self.records)
        settings = dataclasses.replace(settings, boundary_inputs="private")
        queries = Queries.make(
            self.road.geometry.n_mainline, bandwidth, spans, separate_sensors=len(groups) > 1
        )
        model = kind or RELEASE_MODELS[settings.preset]
        task = task_of(model, settings, self.road, queries, n, groups)
        populations = [group.population for group in groups]
        traffic = Traffic(self.road, tuple(range(n)), self, populations)
        traffic.load(np.arange(n))
        return model(task, traffic)

    def started(self, settings, seed=0, ledgers=None, **keywords):
        """A release model whose episodes have begun, with other ledgers if a class is given."""
        release, n = self.release(settings, **keywords), len(self.records)
        if ledgers is not None:
            release.ledgers = ledgers(release.task.channels, n, release.ledgers.terms)
        release.reset(np.arange(n), streams(*range(seed, seed + n)))
        return release


def predicting(density=10.0, speed=60.0, n_episodes=1, n_segments=SEGMENTS):
    """A prediction for a request: the same for every segment, or given by segment."""
    shape = n_episodes, n_segments
    values = (np.broadcast_to(value, shape).astype(float) for value in (density, speed, 1.0, 1.0))
    made = Estimate(*values)
    return lambda: made


def request(time, observed=True, prediction=None, episodes=(0,), n_columns=COLUMNS):
    """A request for a second of some episodes, each of the traffic of its number."""
    episodes = np.array(episodes)
    flags = np.broadcast_to(np.asarray(observed, dtype=bool), (len(episodes), n_columns)).copy()
    return Request(
        episodes, episodes, np.full(len(episodes), time), flags,
        prediction or predicting(n_episodes=len(episodes)),
    )  # fmt: skip


# --- trips that differ in one vehicle -----------------------------------------------------------


@st.composite
def trips(draw, n_vehicles, n_steps, last_place):
    """Places and speeds (n_vehicles, n_steps + 1); few segments, so that vehicles meet."""
    shape = n_vehicles, n_steps + 1
    places = draw(arrays(np.int16, shape, elements=st.integers(AWAY, last_place)))
    speed = st.sampled_from([0.0, LIMIT / 2, LIMIT, 1.5 * LIMIT]) | st.floats(0.0, LIMIT, width=32)
    return places, draw(arrays(np.float32, shape, elements=speed))


@st.composite
def adjacent_trips(draw, asked, most_vehicles, n_steps, last_place):
    """Places and speeds in two worlds that differ in vehicle 0 as `asked` protects."""
    places, speeds = draw(trips(draw(st.integers(1, most_vehicles)), n_steps, last_place))
    other_places, other_speeds = places.copy(), speeds.copy()
    at = np.arange(n_steps + 1)
    if asked.unit == "event":
        at = at[[draw(st.integers(1, n_steps))]]
    new_places, new_speeds = draw(trips(1, n_steps, last_place))
    if asked.adjacency == "add_remove":
        new_places = np.full_like(new_places, AWAY)
    other_places[0, at], other_speeds[0, at] = new_places[0, at], new_speeds[0, at]
    return places, speeds, other_places, other_speeds


def alike_to_loops(corridor, n_vehicles, generator):
    """Places and speeds (n_vehicles, T + 1) in two worlds that have the same readings of a loop.

    In either world a vehicle passes the loop in the same interval at the same speed, and in
    another second of it. Otherwise it jumps about on its side of the loop, at any speed.
    """
    geometry, interval = corridor.geometry, corridor.loops.interval
    n, duration = geometry.n_mainline, corridor.conditions.duration
    (face,) = corridor.loops.faces(geometry).tolist()
    sides = [*range(face), geometry.n_segments], [*range(face, n), geometry.n_segments + 1]
    seconds, shape = np.arange(duration + 1), (2, n_vehicles, duration + 1)
    upstream, downstream = (generator.choice(side, shape) for side in sides)
    speeds = generator.choice([0.0, 51.0, 150.0, *generator.uniform(0.0, 130.0, 3)], shape)
    began = interval * generator.integers(0, duration // interval + 1, n_vehicles)
    passes = (began + generator.integers(1, interval + 1, (2, n_vehicles)))[..., None]
    places = np.where(seconds < passes, upstream, downstream)
    passing = generator.uniform(1.0, 130.0, (n_vehicles, 1))
    speeds = np.where((seconds == passes) | (seconds == passes - 1), passing, speeds)
    return tuple(zip(places, speeds, strict=True))


# --- ledgers under any public numbers -----------------------------------------------------------


class Public(NamedTuple):
    """Public numbers of T seconds: queries (T, C), prices (T, C), and centres (T, places)."""

    observed: np.ndarray
    prices: np.ndarray
    centres: np.ndarray

    @classmethod
    def constant(cls, release, price, centre=LIMIT / 2):
        """All columns at the same price around the same centre, at every second."""
        shape = T, release.task.n_channels
        return cls(np.ones(shape, bool), np.full(shape, price), np.full((T, COLUMNS), centre))


def collected(release, public):
    """Yield the true sums and the refusals of every second of all episodes of a paced release."""
    episodes, n_columns = np.arange(release.task.n_episodes), release.task.n_channels
    for second, numbers in enumerate(zip(*public, strict=True), 1):
        observed, prices, centre = (np.tile(each, (episodes.size, 1)) for each in numbers)
        asked = request(second, observed, episodes=episodes, n_columns=n_columns)
        yield release.collect(asked, prices, centre, sigma_at(release, prices))


def sigma_at(release, prices):
    """Deviations of the noise of a paced release at prices (k, C), shape (k, C, 2)."""
    settings = release.task.settings
    count = 1.0 / np.sqrt(prices)
    return np.stack([count, settings.clip / np.sqrt(settings.ratio) * count], axis=-1)


def squared_distance(release, public):
    """Squared distance of episodes 0 and 1 in units of the declared noise."""
    settings, total = release.task.settings, 0.0
    for (sums, _), observed, prices in zip(
        collected(release, public), public.observed, public.prices, strict=True
    ):
        count, deviation = np.moveaxis((sums[0] - sums[1]) ** 2, -1, 0)
        deviation = deviation * settings.ratio / settings.clip**2
        total += float(((count + deviation) * prices)[observed].sum())
    return total


class PlainLedgers(Ledgers):
    """Ledgers written out in Python."""

    def collect(self, episodes, observed, rows, prices, centre, sigma):
        (first, span, group, _), (_, ratio, clip, _) = self._bundle.parts
        sums = np.zeros((*observed.shape, 2))
        refused = np.zeros((len(observed), self.terms.budget.size), dtype=np.int64)
        for k, episode in enumerate(episodes.tolist()):
            for row in range(rows.start[k], rows.stop[k]):
                place, vehicle = int(rows.cell[row]), int(rows.vehicle[row])
                if place >= centre.shape[1]:
                    continue
                covers = observed[k] & (first <= place) & (place < first + span)
                for column in np.flatnonzero(covers).tolist():
                    g = int(group[column])
                    if rows.speed[g, row] < 0.0:
                        continue
                    raw = float(min(rows.speed[g, row], self.terms.fastest)) - centre[k, place]
                    grid = grid_of(float(sigma[k, column, 1]))
                    most = np.floor(clip / grid)
                    d = min(max(np.rint(raw / grid), -most), most) * grid
                    cost = prices[k, column] * (1.0 + ratio * d * d / (clip * clip))
                    if self.paid[episode, g, vehicle] + cost <= self.terms.budget[g]:
                        self.paid[episode, g, vehicle] += cost
                        sums[k, column] += 1.0, d
                    else:
                        refused[k, g] += 1
        return sums, refused
