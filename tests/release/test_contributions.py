import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.release.contributions import Contributions

from .worlds import AWAY, record

T, COLUMNS, LIMIT = 8, 6, 102.0


@st.composite
def records(draw):
    shape = draw(st.integers(1, 6)), T + 1
    places = draw(arrays(np.int16, shape, elements=st.integers(AWAY, COLUMNS - 1)))
    speeds = draw(arrays(np.float32, shape, elements=st.floats(0, 200, width=32)))
    return record(places, speeds, COLUMNS)


def loaded(some, n_episodes, cap, n_columns=COLUMNS):
    places = np.arange(n_columns)
    contributions = Contributions(len(some), T + 1, n_episodes, LIMIT, cap, places)
    for slot, one in enumerate(some):
        contributions.load(slot, one)
    return contributions


def by_hand(one, masks, cap, n_columns):
    """Count one episode over all its steps with dictionaries."""
    spent, steps = {}, []
    for t, mask in enumerate(masks, start=1):
        counts, speeds = np.zeros((2, n_columns))
        rows = one.rows(t)
        for v, s, speed in zip(one.vehicle[rows], one.segment[rows], one.speed[rows], strict=True):
            if s < n_columns and mask[s] and (cap is None or spent.get(v, 0) < cap):
                spent[v] = spent.get(v, 0) + 1
                counts[s] += 1
                speeds[s] += min(float(speed), LIMIT)
        steps.append((counts, speeds))
    return steps, spent


@settings(max_examples=100)
@given(
    some=st.lists(records(), min_size=2, max_size=3),
    masks=arrays(bool, (2, T, COLUMNS)),
    cap=st.sampled_from([None, 1, 2, 5]),
    n_columns=st.sampled_from([COLUMNS, COLUMNS - 2]),
)
def test_counts_of_a_batch_are_those_by_hand(some, masks, cap, n_columns):
    masks = masks[..., :n_columns]
    contributions, slots = loaded(some, 3, cap, n_columns), np.array([1, 0])
    episodes = np.array([2, 0])
    expected = [by_hand(some[slot], masks[k], cap, n_columns) for k, slot in enumerate(slots)]
    for t in range(1, T + 1):
        counts, speeds = contributions.collect(episodes, slots, np.full(2, t), masks[:, t - 1])
        for k in range(2):
            np.testing.assert_array_equal(counts[k], expected[k][0][t - 1][0])
            np.testing.assert_allclose(speeds[k], expected[k][0][t - 1][1], rtol=1e-12)
    for k, episode in enumerate(episodes):
        exposures = contributions.exposures_of(episode, slots[k])
        assert exposures.shape == (some[slots[k]].n_vehicles,)
        assert {v: n for v, n in enumerate(exposures) if n} == expected[k][1]
    assert not contributions.exposures[1].any()


@settings(max_examples=100)
@given(
    one=records().filter(lambda one: one.n_rows > 0),
    masks=arrays(bool, (T, COLUMNS)),
    cap=st.integers(1, 4),
    data=st.data(),
)
def test_taking_one_vehicle_out_leaves_what_others_contribute(one, masks, cap, data):
    gone = data.draw(st.integers(0, one.n_vehicles - 1))
    contributions = loaded([one, one.without(gone)], 2, cap)
    both = np.arange(2)
    for t in range(1, T + 1):
        counts, _ = contributions.collect(both, both, np.full(2, t), np.stack([masks[t - 1]] * 2))
        fewer = counts[0] - counts[1]
        assert fewer.sum() in (0.0, 1.0)
        assert (fewer >= 0.0).all()
    rest = np.delete(contributions.exposures, gone, axis=1)
    np.testing.assert_array_equal(rest[0], rest[1])


def standing(n_vehicles, place=0):
    return record(np.full((n_vehicles, T + 1), place), np.full((n_vehicles, T + 1), 50.0), COLUMNS)


def test_a_vehicle_counts_in_its_first_queried_steps_and_in_no_later_one():
    contributions = loaded([standing(1)], 1, 3)
    one, asked = np.zeros(1, dtype=np.int64), np.zeros((1, COLUMNS), dtype=bool)
    seen = []
    for t in range(1, T + 1):
        asked[0, 0] = t != 2  # not asked, not charged
        counts, _ = contributions.collect(one, one, np.array([t]), asked)
        seen.append(int(counts[0, 0]))
    assert seen == [1, 0, 1, 1, 0, 0, 0, 0]


def test_a_new_episode_starts_from_nothing_and_leaves_others_alone():
    contributions = loaded([standing(2)], 2, None)
    both, asked = np.arange(2), np.ones((2, COLUMNS), dtype=bool)
    contributions.collect(both, np.zeros(2, dtype=np.int64), np.ones(2, dtype=np.int64), asked)
    contributions.reset(np.array([0]))
    np.testing.assert_array_equal(contributions.exposures, [[0, 0], [1, 1]])


def test_a_wider_record_loaded_later_keeps_what_was_counted():
    contributions = Contributions(2, T + 1, 1, LIMIT, None, np.arange(3))
    one, first = np.zeros(1, dtype=np.int64), np.ones(1, dtype=np.int64)
    contributions.load(0, standing(2))
    contributions.collect(one, one, first, np.ones((1, COLUMNS), dtype=bool))
    contributions.load(1, standing(40))
    assert contributions.exposures.shape == (1, 40)
    assert contributions.exposures.sum() == 2
    assert contributions.exposures_of(0, 0).tolist() == [1, 1]


@pytest.mark.parametrize("cap", [None, 2])
def test_what_is_returned_is_not_the_account_itself(cap):
    contributions = loaded([standing(2)], 1, cap)
    contributions.exposures_of(0, 0)[:] = 99
    assert not contributions.exposures.any()
