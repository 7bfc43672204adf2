import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.spaces.actions import (
    ACTION_ENCODINGS,
    MaskAction,
    PendingPicks,
    ScoresAction,
    SequentialAction,
    SlotsAction,
)

FIRST = np.zeros(1, dtype=np.int64)


class Played:
    """An encoding with the state of a batch of episodes."""

    def __init__(self, kind, n_mainline=6, bandwidth=2, n_episodes=1):
        self.encoding = kind(n_mainline, bandwidth)
        self.pending = PendingPicks(n_episodes, n_mainline)

    def decode(self, actions, episodes=FIRST):
        return self.encoding.decode(episodes, actions, self.pending)


def indices(mask):
    return np.flatnonzero(mask).tolist()


def test_mask_over_budget_is_cut_in_rotation():
    played = Played(MaskAction)
    everything = np.ones((1, 6), dtype=np.int8)
    turns = [indices(played.decode(everything).queried[0]) for _ in range(4)]
    assert turns == [[0, 1], [2, 3], [4, 5], [0, 1]]
    assert played.decode(everything).n_dropped.tolist() == [4]
    played.pending.reset(FIRST)
    assert indices(played.decode(everything).queried[0]) == [0, 1]


def test_mask_takes_the_floats_that_learning_libraries_send():
    played = Played(MaskAction)
    assert indices(played.decode(np.array([[0.0, 1, 0, 0, 0, 0]])).queried[0]) == [1]
    with pytest.raises(ValueError, match="0 and 1 only"):
        played.decode(np.array([[0.0, 0.5, 0, 0, 0, 0]]))


def test_scores_take_the_highest_and_break_ties_upstream():
    played = Played(ScoresAction)
    decision = played.decode(np.array([[0.1, 0.9, -1, 0.9, 0.9, 0]], dtype=np.float32))
    assert indices(decision.queried[0]) == [1, 3]


def test_slots_refill_repeats_in_rotation():
    played = Played(SlotsAction, 6, 3)
    repeated = np.array([[4, 4, 4]])
    first, second = (played.decode(repeated) for _ in range(2))
    assert indices(first.queried[0]) == [0, 1, 4]
    assert indices(second.queried[0]) == [2, 3, 4]
    assert first.n_dropped.tolist() == [2]


def test_sequential_completes_after_bandwidth_picks():
    played = Played(SequentialAction, 6, 3)
    decisions = [played.decode(np.array([pick])) for pick in (5, 2, 0)]
    assert [bool(decision.complete[0]) for decision in decisions] == [False, False, True]
    assert indices(decisions[-1].queried[0]) == [0, 2, 5]
    assert not played.pending.picked.any()


def test_sequential_masks_what_is_taken_and_replaces_a_repeat():
    played = Played(SequentialAction, 4, 2)
    played.decode(np.array([0]))
    assert played.pending.picked[0].tolist() == [True, False, False, False]
    decision = played.decode(np.array([0]))
    assert decision.complete.all()
    assert indices(decision.queried[0]) == [0, 1]
    assert decision.n_dropped.tolist() == [1]
    played.decode(np.array([2]))
    assert played.decode(np.array([3])).n_dropped.tolist() == [0]  # counted anew


def test_episodes_of_a_batch_rotate_on_their_own():
    played = Played(MaskAction, n_episodes=3)
    everything = np.ones((1, 6), dtype=np.int8)
    played.decode(everything, np.array([1]))
    decision = played.decode(np.repeat(everything, 3, axis=0), np.arange(3))
    assert [indices(row) for row in decision.queried] == [[0, 1], [2, 3], [0, 1]]


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(seed=st.integers(0, 2**32 - 1))
def test_decode_undoes_encode(name, seed):
    played = Played(ACTION_ENCODINGS[name], 6, 3)
    wanted = np.zeros((1, 6), dtype=bool)
    wanted[0, np.random.default_rng(seed).permutation(6)[:3]] = True
    for _ in range(played.encoding.actions_per_step):
        decision = played.decode(played.encoding.encode(wanted, played.pending.picked))
    assert (decision.queried == wanted).all()
    assert decision.n_dropped.tolist() == [0]


@pytest.mark.parametrize(
    ("kind", "action", "message"),
    [
        (MaskAction, np.ones(5, dtype=np.int8), r"shape \(6,\) of MultiBinary\(6\), got \(5,\)"),
        (MaskAction, np.full(6, 2), "0 and 1 only"),
        (ScoresAction, np.full(6, np.nan), "finite floats"),
        (SlotsAction, np.array([0.0, 1.0]), "integers"),
        (SlotsAction, np.array([0, 6]), r"\[0, 5\]"),
        (SequentialAction, np.array(-1), r"\[0, 5\]"),
    ],
)
def test_bad_actions_are_refused_and_leave_no_trace(kind, action, message):
    played = Played(kind)
    with pytest.raises(ValueError, match=message):
        played.decode(action[None])
    assert not played.pending.picked.any()


def test_two_batches_of_one_encoding_do_not_meet():
    """The encoding holds no state, so that any number of processes can share an interface."""
    encoding = SequentialAction(6, 2)
    first, second = PendingPicks(1, 6), PendingPicks(1, 6)
    encoding.decode(FIRST, np.array([4]), first)
    decision = encoding.decode(FIRST, np.array([0]), second)
    assert not decision.complete.any()
    assert indices(first.picked[0]) == [4]
    assert indices(second.picked[0]) == [0]
