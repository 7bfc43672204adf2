import math

import numpy as np
import pytest

from dptse_env.utils import validation

NUMBERS = {
    "finite": validation.finite,
    "positive": validation.positive,
    "non_negative": validation.non_negative,
    "inside": lambda path, value: validation.inside(path, value, 0.0, 0.5),
}


def test_good_values_come_back_as_plain_numbers():
    for check in NUMBERS.values():
        for value in (0.25, np.float32(0.25), np.float64(0.25)):
            assert type(check("x", value)) is float
            assert check("x", value) == 0.25
    assert type(validation.positive("x", 3)) is float
    assert type(validation.integer("n", np.int64(4), 1)) is int
    assert validation.sequence("s", [1, 2]) == (1, 2)
    assert validation.interval("i", [1, 2]) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("check", "value", "allowed"),
    [
        ("positive", -1, "> 0"),
        ("positive", 0.0, "> 0"),
        ("non_negative", -0.5, ">= 0"),
        ("inside", 0.0, r"in \(0, 0\.5\)"),
        ("inside", 0.5, r"in \(0, 0\.5\)"),
        *[(name, value, "finite") for name in NUMBERS for value in (math.nan, math.inf)],
        *[(name, value, "a number") for name in NUMBERS for value in (None, True, [1.0], 1j)],
    ],
)
def test_bad_numbers_are_named(check, value, allowed):
    with pytest.raises(ValueError, match=rf"^a\.b must be {allowed}, got "):
        NUMBERS[check]("a.b", value)


def test_non_negative_takes_zero():
    assert validation.non_negative("x", 0) == 0.0


@pytest.mark.parametrize("value", [0, 6, 1.0, "1", True, None])
def test_integers_are_whole_and_in_range(value):
    with pytest.raises(ValueError, match=rf"^n must be an integer in 1\.\.5, got {value!r}$"):
        validation.integer("n", value, 1, 5)
    with pytest.raises(ValueError, match="an integer >= 1"):
        validation.integer("n", 0, 1)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ((2.0, 1.0), "i must be a pair"),
        ((0.0, 1.0), r"i\[0\] must be > 0"),
        ((1.0,), "i must be a sequence of 2"),
        ("12", "i must be a sequence of 2"),
    ],
)
def test_intervals_are_ordered_pairs(value, message):
    with pytest.raises(ValueError, match=message):
        validation.interval("i", value)


def test_an_interval_may_start_at_zero_where_allowed():
    assert validation.interval("i", (0, 1), allow_zero=True) == (0.0, 1.0)
