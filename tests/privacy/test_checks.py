import math

import numpy as np
import pytest

from dptse_env.privacy.checks import finite_positive, inside, positive_count


def test_good_values_come_back_as_plain_numbers():
    for number in (finite_positive("x", np.float32(0.5)), inside("x", np.float64(0.2), 0.0, 0.5)):
        assert type(number) is float
    assert type(finite_positive("x", 3)) is float
    for count in (positive_count("n", np.int64(4)), positive_count("n", 4.0)):
        assert type(count) is int
        assert count == 4


@pytest.mark.parametrize("value", [-1, 0, -0.0, math.nan, -math.inf])
def test_finite_positive_names_the_path_and_the_value(value):
    with pytest.raises(ValueError, match=rf"^a\.b must be > 0, got {value!r}$"):
        finite_positive("a.b", value)


def test_finite_positive_refuses_infinity():
    with pytest.raises(ValueError, match=r"^a\.b must be finite, got inf$"):
        finite_positive("a.b", math.inf)


@pytest.mark.parametrize("value", [0.0, 0.5, -0.1, 0.6, math.nan])
def test_inside_is_open_at_both_ends(value):
    with pytest.raises(ValueError, match=rf"^a\.b must be in \(0, 0\.5\), got {value!r}$"):
        inside("a.b", value, 0.0, 0.5)


@pytest.mark.parametrize("value", [0, -2, 1.5, math.nan, math.inf])
def test_positive_count_refuses_all_but_whole_numbers(value):
    with pytest.raises(ValueError, match=rf"^n must be a whole number >= 1, got {value!r}$"):
        positive_count("n", value)


@pytest.mark.parametrize("value", ["1", None, True, [1.0], 1j])
@pytest.mark.parametrize(
    "check", [finite_positive, positive_count, lambda path, value: inside(path, value, 0.0, 2.0)]
)
def test_what_only_looks_like_a_number_is_refused(check, value):
    with pytest.raises(ValueError, match=r"^x must be a number, got "):
        check("x", value)
