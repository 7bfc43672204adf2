"""Action encodings whose options cost different amounts of the bandwidth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dptse_env.config import resolve
from dptse_env.parts import make_interface
from dptse_env.spaces.actions import (
    ACTION_ENCODINGS,
    MaskAction,
    PendingPicks,
    ScoresAction,
    SequentialAction,
    SlotsAction,
)
from tests.release.sums import SumRelease

FIRST = np.zeros(1, dtype=np.int64)
COSTS = np.array([1, 1, 1, 1, 2, 2, 2, 3])  # of eight options


class Played:
    """An encoding of options with costs, and the state of one episode."""

    def __init__(self, kind, bandwidth, costs=COSTS):
        self.encoding = kind(len(costs), bandwidth, costs=costs)
        self.pending = PendingPicks(1, len(costs))

    def decode(self, action):
        return self.encoding.decode(FIRST, np.asarray(action)[None], self.pending)

    def decided(self, next_action):
        """Play one decision; ``next_action`` gives each action by the picks so far."""
        for _ in range(self.encoding.actions_per_step):
            decision = self.decode(next_action(self.pending.picked))
            if decision.complete[0]:
                return decision
        raise AssertionError("a decision takes more actions than announced")


def flags(*options):
    return np.isin(np.arange(8), options).astype(np.int8)


def indices(decision):
    return np.flatnonzero(decision.queried[0]).tolist()


def is_full(queried, costs, bandwidth):
    """Whether no further option fits."""
    return bool(((costs > bandwidth - queried @ costs) | queried).all())


def test_a_mask_is_cut_to_what_the_bandwidth_pays_for():
    played = Played(MaskAction, 4)
    decision = played.decode(flags(0, 4, 5, 6))
    assert indices(decision) == [0, 4]  # option 5 costs more than is left
    assert decision.n_dropped.tolist() == [2]
    assert indices(played.decode(flags(0, 4, 5, 6))) == [5, 6]


def test_an_option_beyond_the_bandwidth_is_never_queried():
    played = Played(MaskAction, 2)
    assert indices(played.decode(flags(7))) == []
    turns = [indices(played.decode(flags(4, 5, 7))) for _ in range(5)]
    assert turns == [[4], [5], [4], [5], [4]]


@given(seed=st.integers(0, 2**32 - 1), bandwidth=st.integers(3, 8))
def test_rotation_serves_every_request(seed, bandwidth):
    played = Played(MaskAction, bandwidth)
    wanted = np.random.default_rng(seed).integers(0, 2, 8)
    served = sum(played.decode(wanted).queried[0].astype(int) for _ in range(8))
    assert ((served > 0) == (wanted > 0)).all()


def test_scores_pass_over_what_does_not_fit():
    scores = np.array([0.1, 0.2, 0, 0, 0.7, 0.8, 0, 0.9], dtype=np.float32)
    assert indices(Played(ScoresAction, 4).decode(scores)) == [1, 7]
    assert indices(Played(ScoresAction, 5).decode(scores)) == [5, 7]
    assert indices(Played(ScoresAction, 2).decode(scores)) == [5]


def test_slots_are_as_many_as_there_may_be_queries():
    assert Played(SlotsAction, 4).encoding.space.nvec.tolist() == [8] * 4
    assert Played(SlotsAction, 7).encoding.space.nvec.tolist() == [8] * 5
    assert Played(SlotsAction, 99).encoding.space.nvec.tolist() == [8] * 8


def test_slots_are_filled_up_and_cut():
    played = Played(SlotsAction, 4)
    decision = played.decode([7, 7, 7, 7])
    assert indices(decision) == [0, 7]
    assert decision.n_dropped.tolist() == [1]
    decision = played.decode([4, 5, 6, 7])
    assert decision.queried[0] @ COSTS == 4
    assert decision.n_dropped.tolist() == [2]


def test_sequential_is_complete_when_nothing_fits_any_more():
    played = Played(SequentialAction, 4)
    first = played.decode(7)
    assert not first.complete.any()
    free = played.encoding.available(played.pending.picked)
    assert np.flatnonzero(free[0]).tolist() == [0, 1, 2, 3]
    last = played.decode(2)
    assert indices(last) == [2, 7]
    assert last.complete.all()
    assert not played.pending.picked.any()


def test_a_pick_that_does_not_fit_is_replaced_by_one_that_does():
    played = Played(SequentialAction, 4)
    played.decode(7)
    decision = played.decode(6)
    assert indices(decision) == [0, 7]
    assert decision.n_dropped.tolist() == [1]


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(
    seed=st.integers(0, 2**32 - 1),
    costs=st.lists(st.integers(1, 6), min_size=1, max_size=20).map(np.array),
    data=st.data(),
)
def test_no_sampled_action_exceeds_the_bandwidth(name, seed, costs, data):
    bandwidth = data.draw(st.integers(int(costs.min()), int(costs.sum()) + 3))
    played = Played(ACTION_ENCODINGS[name], bandwidth, costs)
    played.encoding.space.seed(seed)
    for _ in range(3):
        decision = played.decided(lambda _: played.encoding.space.sample())
        queried = decision.queried[0]
        assert queried @ costs <= bandwidth
        assert name == "mask" or is_full(queried, costs, bandwidth)


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(
    seed=st.integers(0, 2**32 - 1),
    spans=st.sets(st.integers(1, 6), min_size=1).map(sorted),
    levels=st.lists(st.sampled_from([0.05, 0.5, 1.0, 20.0]), min_size=1, unique=True),
    unit=st.sampled_from(["segments", "sums"]),
    data=st.data(),
)
@settings(max_examples=25)
def test_no_mix_of_spans_and_levels_exceeds_the_bandwidth(name, seed, spans, levels, unit, data):
    bandwidth = data.draw(st.integers(spans[0] if unit == "segments" else 1, 6))
    keywords = {"query_spans": spans, "price_levels": levels, "bandwidth_unit": unit}
    given = {"privacy": SumRelease, "action": name, "bandwidth": bandwidth, **keywords}
    interface = make_interface(resolve("short-highway", given))
    options, encoding = interface.queries, interface.actions
    played = Played(lambda *_, costs: encoding, bandwidth, options.cost)
    encoding.space.seed(seed)
    for _ in range(2):
        decision = played.decided(lambda _: encoding.space.sample())
        assert decision.queried.shape == (1, options.n_options)
        assert decision.queried[0].sum() <= options.most_queries
        assert decision.queried[0] @ options.cost <= bandwidth
        assert name == "mask" or is_full(decision.queried[0], options.cost, bandwidth)


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(seed=st.integers(0, 2**32 - 1), bandwidth=st.integers(1, 13))
def test_decode_undoes_encode(name, seed, bandwidth):
    played = Played(ACTION_ENCODINGS[name], bandwidth)
    wanted = np.zeros((1, 8), dtype=bool)
    for option in np.random.default_rng(seed).permutation(8):
        wanted[0, option] = wanted[0] @ COSTS + COSTS[option] <= bandwidth
    n_actions = 0

    def next_action(picked):
        nonlocal n_actions
        n_actions += 1
        is_last = played.encoding.completes(wanted, picked)
        assert name != "sequential" or is_last[0] == (n_actions == wanted.sum())
        return played.encoding.encode(wanted, picked)[0]

    decision = played.decided(next_action)
    assert (decision.queried == wanted).all()
    assert decision.n_dropped.tolist() == [0]


@pytest.mark.parametrize("kind", [ScoresAction, SlotsAction, SequentialAction])
def test_sets_that_an_encoding_cannot_ask_for_are_refused(kind):
    for wanted in ((7,), (4, 5, 6)):  # too few, too many
        with pytest.raises(ValueError, match="as much as the bandwidth of 4 pays for"):
            Played(kind, 4).encoding.encode(flags(*wanted)[None] > 0, flags()[None] > 0)


@pytest.mark.parametrize("kind", list(ACTION_ENCODINGS.values()))
@given(seed=st.integers(0, 2**32 - 1))
def test_equal_costs_give_the_decisions_of_counted_queries(kind, seed):
    """Costs of one each are another path of the code with the same result."""
    counted, priced = (Played(kind, 3, np.ones(8, dtype=np.int64)) for _ in range(2))
    counted.encoding = kind(8, 3)
    counted.encoding.space.seed(seed)
    for _ in range(9):
        action = counted.encoding.space.sample()
        first, second = counted.decode(action), priced.decode(action)
        np.testing.assert_array_equal(first.queried, second.queried)
        np.testing.assert_array_equal(first.n_dropped, second.n_dropped)
        np.testing.assert_array_equal(first.complete, second.complete)
        np.testing.assert_array_equal(counted.pending.pointer, priced.pending.pointer)
