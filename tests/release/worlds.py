"""Made-up traffic: a few vehicles on a short road, in worlds that differ in one vehicle."""

import dataclasses
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.estimators import Estimate
from dptse_env.release import RELEASE_MODELS, Group, QueryOptions, Request, Task, Traffic
from dptse_env.release.vehicles import Ledgers
from dptse_env.traffic import SHORT_HIGHWAY
from tests.helpers import AWAY, record, short_road

WHOLE = (Group("queries"),)
ONE, BOTH = np.arange(1), np.arange(2)
T, COLUMNS, SEGMENTS, PLACES = 8, 12, 8, 4
"""Seconds, record columns and segments of the short road, and places of columns made up below."""

LIMIT, LENGTH = SHORT_HIGHWAY.speed_limit, SHORT_HIGHWAY.segment_length


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


class Worlds:
    """Records in place of a library: traffic seed k is the k-th of them."""

    def __init__(self, *records, road=None):
        self.records = records
        self.road = road or short_road(records[0].n_steps - 1)

    def get(self, corridor, seed):
        return self.records[seed]

    def ensure(self, corridor, seeds):
        """All records are there."""

    def release(self, settings, kind=None, groups=WHOLE, bandwidth=2):
        """A release model of all record columns, of another class than the settings' if given."""
        n = len(self.records)
        settings = dataclasses.replace(settings, boundary_inputs="private")
        queries = QueryOptions.make(
            self.road.n_mainline, bandwidth, separate_sensors=len(groups) > 1
        )
        task = Task(
            settings.preset, kind or RELEASE_MODELS[settings.preset], settings, self.road, queries,
            self.road.duration, n, groups,
        )  # fmt: skip
        populations = [group.population for group in groups]
        traffic = Traffic(self.road, tuple(range(n)), self, populations)
        traffic.load(np.arange(n))
        return task.model(task, traffic)

    def started(self, settings, seed=0, **keywords):
        """A release model whose episodes have begun."""
        release, n = self.release(settings, **keywords), len(self.records)
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


# --- ledgers by themselves ----------------------------------------------------------------------


def columns_of(first, span, group=None):
    """First places, spans and groups of columns."""
    first = np.asarray(first)
    return first, np.asarray(span), np.zeros_like(first) if group is None else np.asarray(group)


SINGLE = columns_of(range(PLACES), [1] * PLACES)
OVERLAPPING = columns_of([0, 1, 2, 3, 0, 1, 2, 0, 1], [1, 1, 1, 1, 2, 2, 2, 3, 3])
"""Each segment, neighbouring pairs, and three in a row."""
GROUPED = columns_of([0, 1, 2, 3, 1, 3], [1, 1, 2, 1, 1, 1], [0, 0, 0, 0, 1, 1])
"""Queries, and sensors on two of their segments."""


class Public(NamedTuple):
    """Public numbers of T seconds: queries (T, C), prices (T, C), and centres (T, places)."""

    observed: np.ndarray
    prices: np.ndarray
    centres: np.ndarray


def constant(columns, price, centre=LIMIT / 2, observed=True):
    """The same price of every column, centre of every segment and query at every second."""
    shape = T, len(columns[0])
    queried = np.broadcast_to(np.asarray(observed, dtype=bool), shape)
    return Public(queried, np.full(shape, price), np.full((T, PLACES), centre))


class PlainLedgers(Ledgers):
    """Ledgers written out in Python; subclasses get one thing wrong on purpose."""

    def account(self, vehicle, place, column):
        """The account of a group that pays."""
        return vehicle

    def cost(self, price, raw, column, nth):
        """The charge for a deviation before it is clipped, to the nth query of a segment."""
        d = self.told(raw)
        return price * (1.0 + self.ratio * d * d / (self.clip * self.clip))

    def told(self, raw):
        """The deviation that is released."""
        return min(max(raw, -self.clip), self.clip)

    def __init__(self, *args, **keywords):
        super().__init__(*args, **keywords)
        self.accounts = {}

    def reset(self, episodes, n_vehicles=None):
        super().reset(episodes, n_vehicles)
        gone = set(episodes.tolist())
        self.accounts = {key: paid for key, paid in self.accounts.items() if key[0] not in gone}

    def collect(self, episodes, observed, rows, prices, centre):
        first, span, group = self._columns
        sums = np.zeros((*observed.shape, 2))
        refused = np.zeros((len(observed), self.budget.size), dtype=np.int64)
        for k, episode in enumerate(episodes.tolist()):
            for row in range(rows.start[k], rows.stop[k]):
                place, vehicle = int(rows.place[row]), int(rows.vehicle[row])
                if place >= centre.shape[1]:
                    continue
                covers = observed[k] & (first <= place) & (place < first + span)
                for nth, column in enumerate(np.flatnonzero(covers).tolist()):
                    g = int(group[column])
                    if rows.speed[g, row] < 0.0:
                        continue
                    raw = float(min(rows.speed[g, row], self.fastest)) - centre[k, place]
                    key = episode, g, self.account(vehicle, place, column)
                    paid = self.accounts.get(key, 0.0)
                    cost = self.cost(prices[k, column], raw, column, nth)
                    if paid + cost <= self.budget[g]:
                        self.accounts[key] = paid + cost
                        if vehicle < self.paid.shape[2]:
                            self.paid[episode, g, vehicle] += cost
                        sums[k, column] += 1.0, self.told(raw)
                    else:
                        refused[k, g] += 1
        return sums, refused


class Keeping(NamedTuple):
    """Ledgers of some records, each an episode, and their vehicles."""

    ledgers: Ledgers
    traffic: Traffic

    def seconds(self, public):
        """Yield the sums and refusals of every second of all episodes."""
        episodes = np.arange(len(self.ledgers.paid))
        for t in range(len(public.observed)):
            at = np.full(len(episodes), t)
            rows = self.traffic.vehicles(episodes, at + 1)
            observed, prices, centres = (array[at] for array in public)
            yield self.ledgers.collect(episodes, observed, rows, prices, centres)


def keep(records, columns, budget, kind=Ledgers, **settings):
    """Ledgers of a budget, one for all groups or one for each."""
    n_groups, worlds = int(columns[2].max()) + 1, Worlds(*records)
    traffic = Traffic(worlds.road, tuple(range(len(records))), worlds, [None] * n_groups)
    traffic.load(np.arange(len(records)))
    budget = np.broadcast_to(np.float64(budget), n_groups).copy()
    ledgers = kind(columns, len(records), budget, fastest=LIMIT, **settings)
    ledgers.reset(np.arange(len(records)), traffic.n_vehicles)
    return Keeping(ledgers, traffic)


def keep_for(records, settings, columns=SINGLE, kind=Ledgers):
    """Ledgers as the paced release of these settings has them, for other columns."""
    own = Worlds(stays(0, 0.0)).release(settings).ledgers
    return keep(records, columns, own.budget[0], kind, ratio=own.ratio, clip=own.clip)


def exhausting(records, settings, columns=SINGLE, within=T):
    """The price at which a vehicle that pays most has a millionth of its budget left.

    It pays in all seconds, or in as many in a row as are given.
    """
    keeping, least = keep_for(records, settings, columns), 1e-9
    ledgers, public = keeping.ledgers, constant(columns, least)
    paid = [np.zeros_like(ledgers.paid)]
    paid += [ledgers.paid.copy() for _ in keeping.seconds(public)]
    most = max((paid[t + within] - paid[t]).max() for t in range(T + 1 - within))
    return (1.0 - 1e-6) * ledgers.budget[0] * least / most


def square(seconds, public, settings):
    """Squared distance of episodes 0 and 1 in units of the noise that the settings declare."""
    total = 0.0
    for t, (sums, _) in enumerate(seconds):
        count, deviation = np.moveaxis((sums[0] - sums[1]) ** 2, -1, 0)
        deviation = deviation * settings.ratio / settings.clip**2
        total += float(((count + deviation) * public.prices[t])[public.observed[t]].sum())
    return total
