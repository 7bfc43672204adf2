"""Made-up traffic: a few vehicles on a short road, in worlds that differ in one vehicle."""

import dataclasses

import numpy as np

from dptse_env.release import RELEASE_MODELS, ReleaseRequest, ReleaseSetup, TrafficTable
from dptse_env.release.contributions import Contributions
from dptse_env.traffic import SHORT_HIGHWAY, Demand, Record

AWAY = -1
"""Place of a vehicle that is not on the road."""

BOTH = np.arange(2)


def corridor(duration):
    """The short road, with a record of `duration` seconds."""
    demand = Demand(((0.0, 1000.0),), (100.0,))
    return dataclasses.replace(SHORT_HIGHWAY, duration=duration, demand=demand, incident=None)


def record(places, speeds, n_columns):
    """A record of places (V, T + 1) of V vehicles, `AWAY` where there is none, and their speeds."""
    step, vehicle = np.nonzero(np.asarray(places).T != AWAY)
    place, speed = (np.asarray(table)[vehicle, step] for table in (places, speeds))
    return Record(
        step=step, vehicle=vehicle, segment=place, speed=speed,
        n_steps=np.shape(places)[1], n_columns=n_columns,
    )  # fmt: skip


class Worlds:
    """Records in place of a library: traffic seed k is the k-th of them."""

    def __init__(self, *records):
        self.records = records

    def get(self, corridor, seed):
        return self.records[seed]

    def ensure(self, corridor, seeds):
        """All vehicles are present."""

    def release(self, settings, counted=None, horizon=None, kind=None):
        """A release model of all record columns, with other contributions if any are given.

        It is of another class than that of the settings if one is given.
        """
        n, duration = len(self.records), self.records[0].n_steps - 1
        traffic = TrafficTable(corridor(duration), tuple(range(n)), self)
        settings = dataclasses.replace(settings, boundary_inputs="private")
        setup = ReleaseSetup(settings.preset, settings, traffic, 2, horizon or duration, n)
        release = (kind or RELEASE_MODELS[settings.preset])(setup)
        if counted is not None:
            release.contributions = counted
        for index, loaded in traffic.load(np.arange(n)):
            release.load(index, loaded)
        return release


def squared_distance(release, policy, n_steps, always=(), std=None, prediction=None):
    """Squared distance of two worlds' true values in units of the noise, over all steps.

    The policy is a function of what world 0 has released so far, and both worlds are queried and
    predicted alike: the distance given equal past releases, which is what the proof bounds.
    """
    std = release.sigma if std is None else std
    release.reset(BOTH, [np.random.default_rng(1), np.random.default_rng(2)])
    noise = np.random.default_rng(5).standard_normal((n_steps + 1, 2)) * std
    past, total = [], 0.0
    for t in range(1, n_steps + 1):
        observed = np.array(policy(past), dtype=bool)
        observed[list(always)] = True
        request = ReleaseRequest(
            BOTH, BOTH, np.full(2, t), np.stack([observed, observed]), prediction
        )
        values = release.true_values(request)
        total += float(np.sum(((values[0] - values[1])[observed] / std) ** 2))
        released = np.where(observed[:, None], values[0] + noise[t], 0.0)
        past.append((observed, released))
    return total


class Mutant(Contributions):
    """Counts as `key` and `charges` say, in place of once for each vehicle: wrong on purpose."""

    def __init__(self, records, cap, key, charges=lambda segment: True):
        largest_speed = corridor(1).speed_limit
        places = np.arange(records[0].n_columns)
        super().__init__(len(records), records[0].n_steps, len(records), largest_speed, cap, places)
        self.records, self.key, self.charges, self.spent = records, key, charges, {}

    def reset(self, episodes):
        super().reset(episodes)
        self.spent = {}

    def collect(self, episodes, slots, times, observed):
        counts, speeds = np.zeros((2, *observed.shape))
        for k, (slot, time) in enumerate(zip(slots, times, strict=True)):
            whole = self.records[slot]
            for row in range(*whole.rows(int(time)).indices(whole.n_rows)):
                segment = whole.segment[row]
                account = (k, *self.key(whole.vehicle[row], segment))
                charged = self.charges(segment)
                if not observed[k, segment] or (charged and self.spent.get(account, 0) >= self.cap):
                    continue
                self.spent[account] = self.spent.get(account, 0) + charged
                counts[k, segment] += 1
                speeds[k, segment] += min(whole.speed[row], self.vehicles.largest_speed)
        return counts, speeds
