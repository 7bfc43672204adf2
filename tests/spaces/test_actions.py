"""Encodings of actions: what they decode to, within the bandwidth, and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.release import Queries
from dptse_env.spaces.actions import (
    ACTION_ENCODINGS,
    MaskAction,
    PendingPicks,
    ScoresAction,
    SequentialAction,
    SlotsAction,
)

FIRST = np.zeros(1, dtype=np.int64)
EQUAL = np.ones(6, dtype=np.int64)
COSTS = np.array([1, 1, 1, 1, 2, 2, 2, 3])
SEEDS = st.integers(0, 2**32 - 1)


def queries(bandwidth, costs):
    n = len(costs)
    return Queries(np.arange(n), np.ones(n, dtype=np.int64), np.asarray(costs), n, bandwidth)


class Played:
    """An encoding, and the state of one episode."""

    def __init__(self, kind, bandwidth=2, costs=EQUAL):
        self.encoding = kind(queries(bandwidth, costs))
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


def flags(*options, n=8):
    return np.isin(np.arange(n), options).astype(np.int8)


def indices(decision):
    return np.flatnonzero(decision.queried[0]).tolist()


# --- one encoding after the other -------------------------------------------------------------


def test_a_mask_beyond_the_bandwidth_is_cut_in_rotation():
    played = Played(MaskAction)
    everything = flags(*range(6), n=6)
    decisions = [played.decode(everything) for _ in range(4)]
    assert [indices(decision) for decision in decisions] == [[0, 1], [2, 3], [4, 5], [0, 1]]
    assert decisions[0].n_dropped.tolist() == [4]
    played.pending.reset(FIRST)
    assert indices(played.decode(everything)) == [0, 1]


@given(seed=SEEDS, bandwidth=st.integers(3, 8))
def test_rotation_serves_every_request(seed, bandwidth):
    played = Played(MaskAction, bandwidth, COSTS)
    wanted = np.random.default_rng(seed).integers(0, 2, 8)
    served = sum(played.decode(wanted).queried[0].astype(int) for _ in range(8))
    assert ((served > 0) == (wanted > 0)).all()


def test_scores_take_the_highest_that_fit_and_break_ties_in_rotation():
    played = Played(ScoresAction)
    scores = np.array([0.1, 0.9, -1, 0.9, 0.9, 0], np.float32)
    assert [indices(played.decode(scores)) for _ in range(4)] == [[1, 3], [1, 4], [3, 4], [1, 3]]
    played.decode(np.array([0.5, 0.9, 0.7, 0.9, 0.1, 0], np.float32))  # nothing to decide
    assert indices(played.decode(scores)) == [1, 4]
    played.pending.reset(FIRST)
    assert indices(played.decode(scores)) == [1, 3]
    assert indices(played.decode(np.float32([1, 0, 0, 0, 0, 0]))) == [0, 4]
    scores = np.array([0.1, 0.2, 0, 0, 0.7, 0.8, 0, 0.9], dtype=np.float32)
    for bandwidth, queried in ((4, [1, 7]), (5, [5, 7]), (2, [5])):
        assert indices(Played(ScoresAction, bandwidth, COSTS).decode(scores)) == queried


def test_equal_scores_are_a_round_robin_also_where_costs_differ():
    played = Played(ScoresAction)
    found = [indices(played.decode(np.zeros(6, np.float32))) for _ in range(4)]
    assert found == [[0, 1], [2, 3], [4, 5], [0, 1]]
    played = Played(ScoresAction, 3, COSTS)
    served = sum(played.decode(np.ones(8, np.float32)).queried[0].astype(int) for _ in range(9))
    assert served.min() >= 1
    played, scores = Played(ScoresAction, 3, COSTS), flags(4, 5) - 0.5 * flags(0, 1, 2, 3)
    found = [indices(played.decode(scores)) for _ in range(3)]  # the rest of 1 goes to the next
    assert [each[-1] for each in found] == [4, 5, 4]


def test_slots_are_as_many_as_there_may_be_queries_and_are_filled_up_and_cut():
    for bandwidth, slots in ((4, 4), (7, 5), (99, 8)):
        assert Played(SlotsAction, bandwidth, COSTS).encoding.space.nvec.tolist() == [8] * slots
    played = Played(SlotsAction, 4, COSTS)
    decision = played.decode([7, 7, 7, 7])
    assert indices(decision) == [0, 7]
    assert decision.n_dropped.tolist() == [1]
    decision = played.decode([4, 5, 6, 7])
    assert decision.queried[0] @ COSTS == 4
    assert decision.n_dropped.tolist() == [2]


@pytest.mark.parametrize(
    ("costs", "bandwidth", "picks", "queried"),
    [(EQUAL, 2, (0, 0), [0, 1]), (COSTS, 4, (7, 6), [0, 7])],  # a repeat; one that does not fit
)
def test_a_pick_that_cannot_be_is_replaced_and_counted(costs, bandwidth, picks, queried):
    played = Played(SequentialAction, bandwidth, costs)
    played.decode(picks[0])
    decision = played.decode(picks[1])
    assert indices(decision) == queried
    assert decision.n_dropped.tolist() == [1]
    played.decode(2)
    assert played.decode(3).n_dropped.tolist() == [0]  # counted anew


# --- all of them ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(
    seed=SEEDS,
    costs=st.lists(st.integers(1, 6), min_size=1, max_size=20).map(np.array),
    data=st.data(),
)
def test_no_sampled_action_exceeds_the_bandwidth(name, seed, costs, data):
    bandwidth = data.draw(st.integers(int(costs.min()), int(costs.sum()) + 3))
    played = Played(ACTION_ENCODINGS[name], bandwidth, costs)
    played.encoding.space.seed(seed)
    for _ in range(3):
        decision = played.decided(lambda _: played.encoding.space.sample())
        assert decision.queried[0] @ costs <= bandwidth
        assert name == "mask" or not played.encoding.available(decision.queried).any()


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(seed=SEEDS, bandwidth=st.integers(1, 13), differ=st.booleans())
def test_decode_undoes_encode(name, seed, bandwidth, differ):
    costs = COSTS if differ else np.ones(8, dtype=np.int64)
    played = Played(ACTION_ENCODINGS[name], bandwidth, costs)
    wanted = np.zeros((1, 8), dtype=bool)
    for option in np.random.default_rng(seed).permutation(8):
        wanted[0, option] = wanted[0] @ costs + costs[option] <= bandwidth
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


@pytest.mark.parametrize(
    ("kind", "action", "message"),
    [
        (MaskAction, np.ones(5, dtype=np.int8), r"shape \(6,\) of MultiBinary\(6\), got \(5,\)"),
        (MaskAction, np.full(6, 0.5), "0 and 1 only"),
        (MaskAction, np.full(6, np.nan), "0 and 1 only"),
        (ScoresAction, np.full(6, np.nan), "finite floats"),
        (SlotsAction, np.array([0.0, 1.0]), "integers"),
        (SlotsAction, np.array([0, 6]), r"\[0, 5\]"),
        (SequentialAction, np.array(-1), r"\[0, 5\]"),
    ],
)
def test_bad_actions_are_refused_and_leave_no_trace(kind, action, message):
    played = Played(kind)
    with pytest.raises(ValueError, match=message):
        played.decode(action)
    assert not played.pending.picked.any()
    assert played.pending.pointer.tolist() == [0]
