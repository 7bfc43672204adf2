from dataclasses import dataclass

import numpy as np
import pytest

from dptse_env.utils.fields import from_mapping


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


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": "a"}, r"^bike\.wheels is missing"),
        ({"name": "a", "wheels": [], "bell": 1}, r"^bike\.bell is unknown; allowed: name, wheels"),
        ({"name": "a", "wheels": [{"size": "x"}]}, r"^bike\.wheels\[0\]\.size must"),
        ({"name": "a", "wheels": [], "gears": [1]}, r"^bike\.gears must have 2 items, got 1"),
        ({"name": "a", "wheels": [], "light": 1}, r"^bike\.light must be of type bool, got 1"),
        ({"name": "a", "wheels": [], "drive": 3}, r"^bike\.drive must"),
    ],
)
def test_errors_name_the_path(values, message):
    with pytest.raises(ValueError, match=message):
        build(values)
