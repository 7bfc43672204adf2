import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.actions import (
    ACTION_ENCODINGS,
    MaskAction,
    ScoresAction,
    SequentialAction,
    SlotsAction,
)

ONE = np.zeros(1, dtype=np.int64)
NOTHING_PICKED = np.zeros((1, 6), dtype=bool)


def started(kind, n_mainline=6, bandwidth=2, n_episodes=1):
    encoding = kind(n_mainline, bandwidth)
    encoding.start(n_episodes)
    return encoding


def indices(mask):
    return np.flatnonzero(mask).tolist()


def test_mask_within_budget_is_taken_as_it_is():
    decision = started(MaskAction).decode(ONE, np.array([[0, 1, 0, 0, 1, 0]], dtype=np.int8))
    assert indices(decision.queried[0]) == [1, 4]
    assert decision.n_dropped.tolist() == [0]
    assert decision.complete.all()


def test_mask_over_budget_is_cut_in_rotation():
    encoding = started(MaskAction)
    everything = np.ones((1, 6), dtype=np.int8)
    turns = [indices(encoding.decode(ONE, everything).queried[0]) for _ in range(4)]
    assert turns == [[0, 1], [2, 3], [4, 5], [0, 1]]
    assert encoding.decode(ONE, everything).n_dropped.tolist() == [4]
    encoding.reset(ONE)
    assert indices(encoding.decode(ONE, everything).queried[0]) == [0, 1]


def test_rotation_serves_every_request_in_turn():
    encoding = started(MaskAction, 7, 3)
    wanted = np.array([[1, 1, 0, 1, 1, 0, 1]])
    served = sum(encoding.decode(ONE, wanted).queried[0].astype(int) for _ in range(5))
    assert served.tolist() == [3, 3, 0, 3, 3, 0, 3]


def test_mask_takes_the_floats_that_learning_libraries_send():
    encoding = started(MaskAction)
    assert indices(encoding.decode(ONE, np.array([[0.0, 1, 0, 0, 0, 0]])).queried[0]) == [1]
    with pytest.raises(ValueError, match="0 and 1 only"):
        encoding.decode(ONE, np.array([[0.0, 0.5, 0, 0, 0, 0]]))


def test_scores_take_the_highest_and_break_ties_upstream():
    encoding = started(ScoresAction)
    decision = encoding.decode(ONE, np.array([[0.1, 0.9, -1, 0.9, 0.9, 0]], dtype=np.float32))
    assert indices(decision.queried[0]) == [1, 3]


def test_slots_refill_repeats_in_rotation():
    encoding = started(SlotsAction, 6, 3)
    repeated = np.array([[4, 4, 4]])
    first, second = (encoding.decode(ONE, repeated) for _ in range(2))
    assert indices(first.queried[0]) == [0, 1, 4]
    assert indices(second.queried[0]) == [2, 3, 4]
    assert first.n_dropped.tolist() == [2]


def test_sequential_completes_after_bandwidth_picks():
    encoding = started(SequentialAction, 6, 3)
    decisions = [encoding.decode(ONE, np.array([pick])) for pick in (5, 2, 0)]
    assert [bool(decision.complete[0]) for decision in decisions] == [False, False, True]
    assert indices(decisions[-1].queried[0]) == [0, 2, 5]
    assert not encoding.picked.any()


def test_sequential_masks_what_is_taken_and_replaces_a_repeat():
    encoding = started(SequentialAction, 4, 2)
    encoding.decode(ONE, np.array([0]))
    assert encoding.picked[0].tolist() == [True, False, False, False]
    decision = encoding.decode(ONE, np.array([0]))
    assert decision.complete.all()
    assert indices(decision.queried[0]) == [0, 1]
    assert decision.n_dropped.tolist() == [1]


def test_episodes_of_a_batch_rotate_on_their_own():
    encoding = started(MaskAction, n_episodes=3)
    everything = np.ones((1, 6), dtype=np.int8)
    encoding.decode(np.array([1]), everything)
    decision = encoding.decode(np.arange(3), np.repeat(everything, 3, axis=0))
    assert [indices(row) for row in decision.queried] == [[0, 1], [2, 3], [0, 1]]


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(seed=st.integers(0, 2**32 - 1), n_mainline=st.integers(1, 20), data=st.data())
def test_any_sampled_action_asks_for_at_most_the_bandwidth(name, seed, n_mainline, data):
    bandwidth = data.draw(st.integers(1, n_mainline))
    encoding = started(ACTION_ENCODINGS[name], n_mainline, bandwidth)
    encoding.space.seed(seed)
    for _ in range(3):
        for _ in range(encoding.actions_per_step):
            decision = encoding.decode(ONE, np.asarray(encoding.space.sample())[None])
        assert decision.complete.all()
        count = decision.queried.sum()
        assert count == bandwidth if name != "mask" else count <= bandwidth


@pytest.mark.parametrize("name", ACTION_ENCODINGS)
@given(seed=st.integers(0, 2**32 - 1))
def test_decode_undoes_encode(name, seed):
    encoding = started(ACTION_ENCODINGS[name], 6, 3)
    wanted = np.zeros((1, 6), dtype=bool)
    wanted[0, np.random.default_rng(seed).permutation(6)[:3]] = True
    for _ in range(encoding.actions_per_step):
        decision = encoding.decode(ONE, encoding.encode(wanted, encoding.picked))
    assert (decision.queried == wanted).all()
    assert decision.n_dropped.tolist() == [0]


@pytest.mark.parametrize(
    ("kind", "action", "message"),
    [
        (MaskAction, np.ones(5, dtype=np.int8), r"shape \(6,\) of MultiBinary\(6\), got \(5,\)"),
        (MaskAction, np.array(["a"] * 6), "numeric"),
        (MaskAction, np.full(6, 2), "0 and 1 only"),
        (ScoresAction, np.full(6, np.nan), "finite floats"),
        (ScoresAction, np.zeros(6, dtype=np.int64), "finite floats"),
        (SlotsAction, np.array([0.0, 1.0]), "integers"),
        (SlotsAction, np.array([0, 6]), r"\[0, 5\]"),
        (SequentialAction, np.array(-1), r"\[0, 5\]"),
        (SequentialAction, np.array([1]), r"shape \(\)"),
    ],
)
def test_bad_actions_are_refused_and_leave_no_trace(kind, action, message):
    encoding = started(kind)
    with pytest.raises(ValueError, match=message):
        encoding.decode(ONE, action[None])
    assert not encoding.picked.any()


@pytest.mark.parametrize("kind", [ScoresAction, SlotsAction, SequentialAction])
def test_full_encodings_refuse_to_ask_fewer(kind):
    with pytest.raises(ValueError, match="always queries 2"):
        started(kind).encode(np.zeros((1, 6), dtype=bool), NOTHING_PICKED)
