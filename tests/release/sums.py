"""A release model of sums, for tests of queries that cover several segments."""

import numpy as np

from dptse_env.release import ReleaseModel


class SumRelease(ReleaseModel):
    """Averages of true density and centred flow, with noise of the same size for every row."""

    releases_sums = True
    sigma = np.array([4.0, 150.0])  # [veh/km, veh/h]

    @classmethod
    def flow_centre(cls, corridor, settings):
        return 0.5 * corridor.speed_limit

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.streams = {}

    def reset(self, episodes, generators):
        self.streams.update(zip(episodes.tolist(), generators, strict=True))

    def true_values(self, request):
        """Return what is released before noise is added, shape (k, n_columns, 2)."""
        task, corridor = self.task, self.task.corridor
        n, every = corridor.n_segments, corridor.n_segments + corridor.n_boundaries
        values = self.traffic.aggregates(request.traffic, request.times, every)
        values[..., 1] = values[..., 0] * (values[..., 1] - 0.5 * corridor.speed_limit)
        rows = task.rows.averages(values[:, :n])
        return np.concatenate([rows, values[:, n:]], axis=1)[:, : task.n_columns]

    def release(self, request):
        values = self.true_values(request).copy()
        for k, episode in enumerate(request.episodes.tolist()):
            values[k] += self.sigma * self.streams[episode].standard_normal(values[k].shape)
        return self.measurement(request, values, self.sigma)


class PricedRelease(SumRelease):
    """The same with a price of 0.01 times the level of a query, and a tracer that grows."""

    has_prices = True

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.prices = np.zeros((task.n_episodes, task.queries.n_options))
        self.tracer = np.zeros((task.n_episodes, task.corridor.n_mainline))

    def reset(self, episodes, generators):
        super().reset(episodes, generators)
        self.prices[episodes], self.tracer[episodes] = 0.0, 0.0

    def release(self, request):
        queries = self.task.queries
        asked = request.observed[:, : queries.n_options]
        before = self.prices[request.episodes]
        self.prices[request.episodes] = np.where(asked, 0.01 * queries.level, before)
        self.tracer[request.episodes] += 0.25 * self.task.covered(request.observed)
        return super().release(request)

    def public(self, episodes):
        return {"prices": self.prices[episodes], "tracer": self.tracer[episodes]}


class MeanRelease(SumRelease):
    """One that says that it releases sums, and releases mean speeds."""

    @classmethod
    def flow_centre(cls, corridor, settings):
        return None
