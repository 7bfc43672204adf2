import math

import numpy as np
import pytest

from dptse_env.utils import validation

NUMBERS = {
    "positive": validation.positive,
    "non_negative": validation.non_negative,
    "inside": lambda path, value: validation.inside(path, value, 0.0, 0.5),
}
NO_NUMBERS = (math.nan, math.inf, None, True, [1.0], 1j)
"""Values that no check takes for a number."""


def test_good_values_come_back_as_plain_numbers():
    for check in NUMBERS.values():
        for value in (0.25, np.float32(0.25), np.float64(0.25)):
            assert type(check("x", value)) is float
            assert check("x", value) == 0.25
    assert type(validation.positive("x", 3)) is float
    assert type(validation.integer("n", np.int64(4), 1)) is int


BEYOND = {"positive": (-1, 0.0), "non_negative": (-0.5,), "inside": (0.0, 0.5)}


@pytest.mark.parametrize("check", NUMBERS)
def test_bad_numbers_are_named(check):
    for value in (*BEYOND[check], *NO_NUMBERS):
        with pytest.raises(ValueError, match=r"^a\.b must be a .*, got "):
            NUMBERS[check]("a.b", value)


def test_non_negative_takes_zero():
    assert validation.non_negative("x", 0) == 0.0


@pytest.mark.parametrize("value", [0, 6, 1.0, "1", True, None])
def test_integers_are_whole_and_in_range(value):
    with pytest.raises(ValueError, match=rf"^n must be .*, got {value!r}$"):
        validation.integer("n", value, 1, 5)
