"""Made-up traffic under ledgers: public numbers, distances, and ledgers written out in Python."""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators import Estimate
from dptse_env.release import ReleaseRequest
from dptse_env.release.ledgers import Columns, Ledgers, Sums
from dptse_env.release.vehicle_table import VehicleTable

from .worlds import AWAY, BOTH, Worlds, corridor, record

T, COLUMNS, PLACES = 8, 12, 4
LIMIT = corridor(T).speed_limit

SINGLE = Columns(np.arange(PLACES), np.ones(PLACES, dtype=np.int64), PLACES)
OVERLAPPING = Columns(
    np.array([0, 1, 2, 3, 0, 1, 2, 0, 1]), np.array([1, 1, 1, 1, 2, 2, 2, 3, 3]), PLACES
)
"""Each segment, neighbouring pairs, and three in a row."""


class Public(NamedTuple):
    """Public numbers of T seconds: queries (T, C), prices (T, C), and centres (T, places)."""

    observed: np.ndarray
    prices: np.ndarray
    centres: np.ndarray


def constant(columns, price, centre=LIMIT / 2, observed=True):
    """The same price of every column, centre of every segment and query at every second."""
    shape = T, len(columns.first)
    queried = np.broadcast_to(np.asarray(observed, dtype=bool), shape)
    return Public(queried, np.full(shape, price), np.full((T, columns.n_places), centre))


def budget_of(settings):
    """The budget of a vehicle in the release model of these settings."""
    return Worlds(stays(0, 0.0)).release(settings).ledgers.budget


def keep_ledgers(records, settings, columns=SINGLE, kind=Ledgers):
    """Ledgers of the release model of these settings, for other columns."""
    table = VehicleTable(len(records), T + 1, LIMIT)
    made = kind(
        columns, table, len(records),
        budget=budget_of(settings), clip=settings.clip, ratio=settings.ratio,
    )  # fmt: skip
    for slot, loaded in enumerate(records):
        made.load(slot, loaded)
    return made


def collect(ledgers, public, episodes=BOTH):
    """The sums of every second of so many episodes, each of which has the record of its number."""
    for t in range(len(public.observed)):
        rows = np.full(len(episodes), t)
        yield ledgers.collect(episodes, episodes, rows + 1, *(array[rows] for array in public))


def exhausting(records, settings, columns, within=T):
    """The price at which a vehicle that pays most has a millionth of its budget left.

    It pays in all seconds, or in as many in a row as are given.
    """
    ledgers, least = keep_ledgers(records, settings, columns), 1e-9
    public = constant(columns, least)
    paid = [np.zeros_like(ledgers.paid), *(ledgers.paid.copy() for _ in collect(ledgers, public))]
    most = max((paid[t + within] - paid[t]).max() for t in range(T + 1 - within))
    return (1.0 - 1e-6) * ledgers.budget * least / most


def square(sums, public, settings):
    """Squared distance of episodes 0 and 1 in units of the noise that the settings declare."""
    total = 0.0
    for t, second in enumerate(sums):
        count = np.subtract(*second.counts) ** 2
        deviation = np.subtract(*second.deviations) ** 2 * settings.ratio / settings.clip**2
        total += float(((count + deviation) * public.prices[t])[public.observed[t]].sum())
    return total


def stays(place, speed, present=True):
    """A record of one vehicle that stays on a segment; second 0 is empty."""
    return drives(np.full(T, place if present else AWAY), speed)


def drives(places, speed):
    """A record of one vehicle at given segments from second 1 on."""
    places = np.concatenate([[AWAY], places])[None]
    return record(places, np.broadcast_to(speed, places.shape), COLUMNS)


class PlainLedgers(Ledgers):
    """Ledgers written out in Python; subclasses get one thing wrong on purpose."""

    def account(self, vehicle, place, column):
        """The account that pays."""
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

    def reset(self, episodes):
        gone = set(episodes.tolist())
        self.accounts = {key: paid for key, paid in self.accounts.items() if key[0] not in gone}

    def paid_by(self, episode, slot):
        n_vehicles = int(self.vehicles.n_vehicles[slot])
        return np.array([self.accounts.get((episode, v), 0.0) for v in range(n_vehicles)])

    def collect(self, episodes, slots, times, observed, prices, centre):
        counts, deviations = np.zeros((2, *observed.shape))
        refused = np.zeros(len(episodes), dtype=np.int64)
        for k, (slot, time) in enumerate(zip(slots, times, strict=True)):
            table = self.vehicles
            for row in range(table.start[slot, time], table.start[slot, time + 1]):
                place, vehicle = int(table.segment[row]), int(table.vehicle[row])
                if place >= self.n_places:
                    continue
                raw = float(table.speed[row]) - centre[k, place]
                covering = np.flatnonzero(observed[k] & (self.covers[:, place] > 0.0))
                for nth, column in enumerate(covering.tolist()):
                    key = int(episodes[k]), self.account(vehicle, place, column)
                    paid = self.accounts.get(key, 0.0)
                    cost = self.cost(prices[k, column], raw, column, nth)
                    if paid + cost <= self.budget:
                        self.accounts[key] = paid + cost
                        counts[k, column] += 1.0
                        deviations[k, column] += self.told(raw)
                    else:
                        refused[k] += 1
        return Sums(counts, deviations, refused)


def predicting(density=10.0, speed=60.0, n_episodes=1):
    """A prediction for a request: the same for every segment, or given by segment."""
    shape = n_episodes, corridor(T).n_segments
    values = (np.broadcast_to(value, shape).astype(float) for value in (density, speed, 1.0, 1.0))
    made = Estimate(*values)
    return lambda: made


def request(time, observed=True, prediction=None, episodes=(0,), traffic=None, n_columns=COLUMNS):
    """A request for a second of some episodes."""
    episodes = np.array(episodes)
    flags = np.broadcast_to(np.asarray(observed, dtype=bool), (len(episodes), n_columns)).copy()
    return ReleaseRequest(
        episodes,
        episodes if traffic is None else np.array(traffic),
        np.full(len(episodes), time),
        flags,
        prediction or predicting(n_episodes=len(episodes)),
    )


def streams(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def standardised(worlds, settings, kind=None, rounds=80, seed=3):
    """True sums and releases of all columns in units of the declared noise, (seconds, C, 2).

    A twin at the same prices and centres says what is true, as an adversary works it out.
    """
    release, twin = worlds.release(settings, kind=kind), worlds.release(settings)
    length = release.setup.corridor.segment_length
    release.reset(np.array([0]), streams(seed))
    true, released = [], []
    for second in np.tile(np.arange(1, T + 1), rounds).tolist():
        asked = request(second, prediction=predicting(np.linspace(5.0, 90.0, 8)))
        found = release.release(asked)
        sums = twin.collect(asked, release.prices, release.centres)
        expected = np.stack([sums.counts, sums.deviations], axis=-1) / length
        true.append((expected / found.sigma)[0])
        released.append((found.values / found.sigma)[0])
    return np.array(true), np.array(released)
