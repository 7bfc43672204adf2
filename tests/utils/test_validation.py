import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from dptse_env.utils import validation
from dptse_env.utils.validation import from_mapping
from tests.hostile import nested


@dataclass(frozen=True)
class Wheel:
    size: float
    spokes: int = 32


@dataclass(frozen=True)
class Engine:
    power: float = 1.0


@dataclass(frozen=True)
class Bike:
    name: str
    wheels: tuple[Wheel, ...]
    drive: Engine | None = None
    gears: tuple[int, int] = (1, 7)
    light: bool = False


def build(values, base=None):
    return from_mapping(Bike, values, "bike", base)


def test_nested_mappings_become_dataclasses():
    bike = build(
        {"name": "a", "wheels": [{"size": 28}, {"size": 26.5, "spokes": np.int64(36)}],
         "drive": {"power": 2}, "gears": [3, 9]}
    )  # fmt: skip
    assert bike == Bike("a", (Wheel(28.0), Wheel(26.5, 36)), Engine(2.0), (3, 9))
    assert isinstance(bike.wheels[0].size, float)


def test_a_base_supplies_what_is_left_out():
    base = Bike("a", (Wheel(28.0),), Engine(2.0))
    assert build({"light": True}, base) == Bike("a", (Wheel(28.0),), Engine(2.0), light=True)
    assert build({"drive": None}, base).drive is None
    assert build({}, base) == base
    assert from_mapping(Bike, base, "bike") is base


BAD = [
    ({"name": "a"}, "wheels is missing"),
    ({"name": "a", "wheels": [], "bell": 1}, "bell is unknown"),
    ({"name": 1, "wheels": []}, "name must be of type str"),
    ({"name": "a", "wheels": "ab"}, "wheels must be a sequence"),
    ({"name": "a", "wheels": [{"size": "x"}]}, r"wheels\[0\]\.size must be"),
    ({"name": "a", "wheels": [{"sise": 1}]}, r"wheels\[0\]\.sise is unknown"),
    ({"name": "a", "wheels": [], "gears": [1]}, "gears must have 2 items"),
    ({"name": "a", "wheels": [], "gears": [1, True]}, r"gears\[1\] must be an integer"),
    ({"name": "a", "wheels": [], "light": 1}, "light must be of type bool"),
    ({"name": "a", "wheels": [], "drive": {"torque": 1}}, r"drive\.torque is unknown"),
    ({"name": "a", "wheels": [], "drive": 3}, "drive must be a mapping"),
]


def test_errors_name_the_path():
    for values, message in BAD:
        with pytest.raises(ValueError, match=rf"^bike\.{message}"):
            build(values)
    with pytest.raises(ValueError, match=r"^bike must be a mapping"):
        build(3)
    with pytest.raises(ValueError, match=r"^bell is unknown"):
        from_mapping(Bike, {"bell": 1}, "")


def test_numbers_come_back_plain_and_bad_ones_are_named():
    for check, beyond in (
        (validation.positive, (-1, 0.0)),
        (validation.non_negative, (-0.5,)),
        (partial(validation.inside, low=0.0, high=0.5), (0.0, 0.5)),
    ):
        for value in (0.25, np.float32(0.25), np.float64(0.25)):
            assert type(check("x", value)) is float
            assert check("x", value) == 0.25
        for value in (*beyond, math.nan, math.inf, None, True, [1.0], 1j):
            with pytest.raises(ValueError, match=r"^a\.b must be a .*, got "):
                check("a.b", value)
    assert validation.non_negative("x", 0) == 0.0
    assert type(validation.positive("x", 3)) is float
    assert type(validation.integer("n", np.int64(4), 1)) is int
    for value in (0, 6, 1.0, "1", True, None):
        with pytest.raises(ValueError, match=rf"^n must be .*, got {value!r}$"):
            validation.integer("n", value, 1, 5)
    assert validation.convert(int, 10**400, "n") == 10**400
    with pytest.raises(ValueError, match=r"^n must be a finite number, got an integer of 400 "):
        validation.convert(float, 10**400, "n")


def test_values_are_shown_in_one_short_line():
    for value, text in (
        (10**5000, "an integer of 5000 digits"),
        ([10**5000], "[an integer of 5000 digits]"),
        (10**20, "100000000000000000000"),
        ("a\nb", r"'a\nb'"),
        (nested(5000), "[[[[[[...]]]]]]"),
        (np.zeros((2, 2)), "array([[0., 0.], [0., 0.]])"),
    ):
        assert validation.shown(value) == text
    assert validation.cut("a b\n") == r"a b\n"
    assert max(len(validation.shown("x" * 10**6)), len(validation.cut("x" * 10**6))) <= 203
