"""Pacings: prices from public numbers, beside the same prices written out place by place."""

import numpy as np
import pytest

from dptse_env.release import Group, Paced, PacedSettings, Queries
from dptse_env.release.pacing import EventPacing, TripPacing
from dptse_env.traffic import SHORT_HIGHWAY
from tests.helpers import UNEVEN

from .worlds import ONE, WHOLE, task_of

BUDGET, RATIO = 2.0, 0.6
N, S, LENGTH = (
    SHORT_HIGHWAY.geometry.n_mainline,
    SHORT_HIGHWAY.geometry.n_segments,
    SHORT_HIGHWAY.geometry.segment_length,
)
SHARE, LARGEST = 1.0 + 0.5 * RATIO, 1.0 + RATIO
"""Expected and largest payment over the price."""
STANDING = 0.0
NOTHING = []
TWO = Group("queries", 0.75), Group("sensors", 0.25)


def make(
    kind=TripPacing, *, road=SHORT_HIGHWAY, bandwidth=3, spans=(1,), sensors=(),
    boundary="nominal", n_episodes=1, groups=WHOLE,
):  # fmt: skip
    """A pacing of half the road a second, unless another bandwidth is given."""
    road = road.replaced(fixed_sensors=sensors)
    queries = Queries.make(
        road.geometry.n_mainline, bandwidth, spans, separate_sensors=len(groups) > 1
    )
    settings = PacedSettings(ratio=RATIO, boundary_inputs=boundary)
    task = task_of(Paced, settings, road, queries, n_episodes, groups)
    pacing = kind(task, BUDGET * task.shares)
    pacing.reset(np.arange(n_episodes))
    return pacing


def prices_of(pacing, observed, density=10.0, speed=60.0, episodes=ONE):
    """Prices of a second of some episodes; columns are observed by index or by flags."""
    task = pacing.task
    flags = np.zeros((len(episodes), task.n_channels), dtype=bool)
    flags[:, observed] = True
    shape = len(episodes), task.corridor.geometry.n_segments
    given = (np.broadcast_to(value, shape).astype(float) for value in (density, speed))
    return pacing.prices(episodes, flags, *given)


def seconds_on(speed, length=LENGTH):
    return 3600.0 * length / np.clip(speed, 8.0, 102.0)


# --- the spent share ------------------------------------------------------------------------------


class PlainPacing:
    """A `TripPacing` of one episode and one group, with its part of the budget."""

    def __init__(self, task, group):
        self.task, self.budget = task, BUDGET * task.shares[group]
        self.road, self.columns = task.corridor.road, np.flatnonzero(task.channels.group == group)
        queries, always = task.queries, [c for c in task.always if c in self.columns]
        self.rate, self.spent = np.zeros((2, task.n_cells))
        self.rate[task.channels.first[always]] = 1.0
        if group == 0:
            bought = queries.bandwidth * np.mean(queries.span / queries.cost)
            every = self.rate[: queries.n_mainline]
            np.maximum(every, min(bought / queries.n_mainline, 1.0), out=every)
        # Boundary segments before the entries and after the exits, where they are released.
        road, released = self.road, task.n_cells > self.road.n_segments
        self.lengths = road.lengths[: road.n_segments]
        self.before = dict(zip(road.entries, road.entry_cells, strict=True)) if released else {}
        self.after = dict(zip(road.exits, road.exit_cells, strict=True)) if released else {}

    def prices(self, observed, density, speed):
        """Prices of the group's columns."""
        self.spent = self.carried(density, speed)
        rest = self.remaining(speed)
        left = np.maximum(self.budget - self.spent, 0.01 * self.budget)
        prices, seen = {}, np.zeros_like(self.spent)
        for c in self.columns:
            first = self.task.channels.first[c]
            covered = slice(first, first + self.task.channels.span[c])
            prices[c] = (left[covered] / rest[covered]).mean()
            if observed[c]:
                seen[covered] += prices[c]
        self.spent = self.spent + SHARE * seen
        self.rate += ((seen > 0.0) - self.rate) / 60.0
        return np.array(list(prices.values()))

    def carried(self, density, speed):
        """Spent shares after predicted flows have mixed them for a second."""
        road, old, new = self.road, self.spent, self.spent.copy()
        flow = density * speed
        for s, length in enumerate(self.lengths):
            arriving = [
                (share * flow[start], old[start])
                for (start, end), share in zip(road.edges, road.edge_share, strict=True)
                if end == s
            ]
            if s in road.entries:
                arriving.append((flow[s], old[self.before[s]] if s in self.before else 0.0))
            total = sum(each for each, _ in arriving)
            if total > 0.0:
                part = min(total / 3600.0 / (length * max(density[s], 1e-9)), 1.0)
                mean = sum(each * spent for each, spent in arriving) / total
                new[s] = old[s] + part * (mean - old[s])
        moved = np.minimum(speed / 3600.0 / self.lengths, 1.0)
        for s, place in self.before.items():  # vehicles enter with nothing
            new[place] = old[place] * (1.0 - moved[s])
        for s, place in self.after.items():
            new[place] = old[place] + moved[s] * (old[s] - old[place])
        return new

    def remaining(self, speed):
        """Queried seconds to the end of a trip that keeps to the mainline where it can."""
        seconds, rest = seconds_on(speed, self.lengths), np.zeros_like(self.spent)
        # Of two that follow, the lower one is on the mainline.
        following = dict(sorted(map(tuple, self.road.edges), reverse=True))

        def of(s):
            ahead = of(following[s]) if s in following else LARGEST
            if s in self.after:
                ahead = rest[self.after[s]] = LARGEST + seconds[s] * self.rate[self.after[s]]
            return ahead + seconds[s] * self.rate[s]

        for s in range(len(seconds)):
            rest[s] = of(s)
        for s, place in self.before.items():
            rest[place] = rest[s] + seconds[s] * self.rate[place]
        return rest


ROADS = {
    "plain": {},
    "sums": {"spans": (1, 2, 3), "sensors": (5, 2)},
    "boundaries": {"sensors": (7,), "boundary": "private", "bandwidth": 1},
    "groups": {"sensors": (5, 7), "boundary": "private", "groups": TWO},
    "uneven": {"road": UNEVEN, "boundary": "private"},
}


@pytest.mark.parametrize("keywords", ROADS.values(), ids=ROADS)
def test_prices_and_the_spent_share_are_as_when_written_out(keywords):
    """In free, in dense and in no traffic; some of the budget's end is reached."""
    pacing, generator = make(**keywords), np.random.default_rng(0)
    task = pacing.task
    plain = [PlainPacing(task, group) for group in range(len(task.groups))]
    n, n_segments = task.corridor.geometry.n_mainline, task.corridor.geometry.n_segments
    for second in range(150):
        density = generator.choice([0.0, 10.0, 60.0, 250.0], n_segments)
        speed = generator.choice([STANDING, 4.0, 30.0, 100.0, 400.0], n_segments)
        observed = generator.random(task.n_channels) < 0.5
        if second < 60:  # the first segments are queried all the time, and traffic stands there
            observed[:2], speed[:3] = True, STANDING
        (found,) = prices_of(pacing, observed, density, speed)
        expected = [each.prices(observed, density, speed) for each in plain]
        np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-9)
        part = np.minimum(plain[0].spent[:n] / plain[0].budget, 1.0)
        np.testing.assert_allclose(pacing.spent_share(ONE)[0], part, rtol=1e-9)


@pytest.mark.parametrize(("speed", "bandwidth"), [(2.0, 1), (50.0, 6), (110.0, 6)])
def test_a_price_spends_the_budget_over_the_queried_rest_of_a_trip(speed, bandwidth):
    pacing = make(bandwidth=bandwidth)
    prices, ahead = prices_of(pacing, NOTHING, 10.0, speed)[0], N - np.arange(N)
    expected = BUDGET / (LARGEST + bandwidth / N * seconds_on(speed) * ahead)
    np.testing.assert_allclose(prices[:N], expected, rtol=1e-12)
    # The on-ramp feeds segment 2 and is not queried; the off-ramp is the end of a trip.
    np.testing.assert_allclose(prices[N:], [expected[2], BUDGET / LARGEST], rtol=1e-12)
    assert pacing.expected_prices(np.full(S, speed)) == pytest.approx(expected[:1])


@pytest.mark.parametrize("clear", [100.0, 30.0])
def test_a_vehicle_has_spent_most_of_its_budget_at_the_end_of_its_trip(clear):
    """One that is as fast as predicted, and deviates as much as is expected."""
    pacing, speed = make(bandwidth=2), np.full(S, clear)
    speed[6] = 0.0  # nobody enters on the way
    paid, place, start = 0.0, 0.0, 198
    for second in range(10_000):
        queried = [second % 6, (second + 3) % 6]
        prices = prices_of(pacing, queried, 20.0, speed)[0]
        if second >= start:
            here = int(place / LENGTH)
            paid, place = paid + SHARE * prices[here] * (here in queried), place + clear / 3600.0
            if place >= N * LENGTH:
                break
    assert 0.6 < paid / BUDGET < 1.0


def test_episodes_do_not_meet_and_a_reset_begins_anew():
    batch, single, others = make(n_episodes=3), make(), np.array([2, 0])
    fresh = prices_of(make(), NOTHING, 20.0, 40.0)
    for second in range(20):
        together = prices_of(batch, [second % 6], 20.0, 40.0, others)
        alone = prices_of(single, [second % 6], 20.0, 40.0)
        np.testing.assert_array_equal(together, np.repeat(alone, 2, axis=0))
    np.testing.assert_array_equal(batch.spent_share(others), single.spent_share(ONE)[[0, 0]])
    assert not batch.spent_share(np.array([1])).any()
    batch.reset(np.array([2]))
    for episode in np.array([[1], [2]]):
        assert not batch.spent_share(episode).any()
        np.testing.assert_array_equal(prices_of(batch, NOTHING, 20.0, 40.0, episode), fresh)


# --- seconds with a budget of their own ------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_second_s_budget_covers_all_queries_of_a_segment(seed):
    pacing = make(EventPacing, spans=(1, 2, 3))
    observed = np.random.default_rng(seed).random(pacing.task.n_channels) < 0.3
    prices = prices_of(pacing, observed)[0]
    whole = BUDGET / (1.0 + RATIO)
    sums = (prices * observed) @ pacing.task.covers
    assert sums.max() == pytest.approx(whole, rel=1e-12)
    assert (sums <= whole * (1.0 + 1e-12)).all()
    # A query that is not made has the price that it would have beside the others.
    for column in np.flatnonzero(~observed)[::5]:
        with_it = observed.copy()
        with_it[column] = True
        assert prices[column] == pytest.approx(prices_of(pacing, with_it)[0, column], rel=1e-12)


def test_single_queries_of_a_second_have_the_whole_of_their_group_s():
    pacing = make(EventPacing, sensors=(5,), groups=TWO)
    prices, whole = prices_of(pacing, [0, 3, 5, 8])[0], BUDGET / (1.0 + RATIO)
    np.testing.assert_allclose(prices, whole * np.where(np.arange(9) < N, 0.75, 0.25))
    np.testing.assert_allclose(
        pacing.expected_prices(np.full(S, 60.0)), [0.75 * whole, 0.25 * whole]
    )
    assert not pacing.spent_share(ONE).any()
