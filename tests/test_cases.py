"""`tests.cases` leaves the right cases in the fast set."""

from tests.cases import fast_and_slow, pairwise


def split(cases):
    slow = [case.values for case in cases if case.marks]
    return [case.values for case in cases if not case.marks], slow


def test_two_axes_are_covered_by_the_longer_one():
    fast, slow = split(pairwise("ab", range(4)))
    assert len(fast) == 6
    assert {x for x, _ in fast} == {"a", "b"}
    assert {y for _, y in fast} == {0, 1, 2, 3}
    assert len({*fast, *slow}) == 8
    assert len(pairwise("ab", range(4), rest=False)) == 6


def test_pairs_of_three_axes_of_two_are_covered_by_six_cases():
    fast, _ = split(pairwise("ab", "cd", "ef"))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert len({(case[i], case[j]) for case in fast}) == 4


def test_cases_by_hand_are_fast_and_the_others_slow():
    assert split(fast_and_slow([1, 2, 3], fast=[2])) == ([(2,)], [(1,), (3,)])
