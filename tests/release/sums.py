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

    def __init__(self, setup):
        super().__init__(setup)
        self.streams = {}

    def reset(self, episodes, generators):
        self.streams.update(zip(episodes.tolist(), generators, strict=True))

    def true_values(self, request):
        """Return what is released before noise is added, shape (k, n_columns, 2)."""
        setup, corridor = self.setup, self.setup.corridor
        n, every = corridor.n_segments, corridor.n_segments + corridor.n_boundaries
        values = setup.traffic.aggregates(request.traffic, request.times, every)
        values[..., 1] = values[..., 0] * (values[..., 1] - 0.5 * corridor.speed_limit)
        rows = setup.rows.averages(values[:, :n])
        return np.concatenate([rows, values[:, n:]], axis=1)[:, : setup.n_columns]

    def release(self, request):
        values = self.true_values(request).copy()
        for k, episode in enumerate(request.episodes.tolist()):
            values[k] += self.sigma * self.streams[episode].standard_normal(values[k].shape)
        return self.measurement(request, values, self.sigma)


class PricedRelease(SumRelease):
    """The same with a price of 0.01 times the level of a query, and a tracer that grows."""

    has_prices = True

    def __init__(self, setup):
        super().__init__(setup)
        self.prices = np.zeros((setup.n_episodes, setup.queries.n_options))
        self.tracer = np.zeros((setup.n_episodes, setup.corridor.n_mainline))

    def reset(self, episodes, generators):
        super().reset(episodes, generators)
        self.prices[episodes], self.tracer[episodes] = 0.0, 0.0

    def release(self, request):
        queries = self.setup.queries
        asked = request.observed[:, : queries.n_options]
        before = self.prices[request.episodes]
        self.prices[request.episodes] = np.where(asked, 0.01 * queries.level, before)
        self.tracer[request.episodes] += 0.25 * self.setup.covered(request.observed)
        return super().release(request)

    def public_state(self, episodes):
        return self.prices[episodes], self.tracer[episodes]


class MeanRelease(SumRelease):
    """One that says that it releases sums, and releases mean speeds."""

    @classmethod
    def flow_centre(cls, corridor, settings):
        return None
