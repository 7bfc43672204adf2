"""What sources say: stations of loops, probes, and values that are refused."""

import math

import pytest

from dptse_env import Seen, probes, station

NAN = float("nan")
READING = {"km": 1.2, "seconds": 60}


def test_a_station_says_flow_and_speed_at_a_point():
    said = station(**READING, count=50, speed=75.0, until=120, ramp=4)
    assert said == station(**READING, flow=3000.0, speed=75.0, until=120, ramp=4)
    assert (said.start, said.end, said.seconds, said.until, said.ramp) == (1.2, 1.2, 60, 120, 4)
    assert (said.flow, said.speed, said.density, said.speed_std) == (3000.0, 75.0, None, None)
    nothing = station(**READING, count=0, speed=NAN)
    assert (nothing.flow, nothing.speed) == (0.0, None)


def test_the_deviation_of_probes_falls_with_their_number():
    said = probes(0.0, 0.2, 80.0, vehicles=9, seconds=60)
    assert (said.density, said.density_std) == (None, None)
    assert said.speed_std == pytest.approx(12.0 / math.sqrt(9))


READINGS = [
    ({"count": 10}, r"station\.speed must be a number where count is above 0, got None"),
    ({"flow": 10.0}, r"station\.speed must be a number where flow is above 0, got None"),
    ({"speed": 80}, r"station\.count must be given where flow is not, .*, got None"),
    ({"count": 1, "flow": 60, "speed": 80}, r"station\.count must be given where .*, got 1"),
    ({"count": -1, "speed": 80}, r"station\.count must be a finite number >= 0, got -1"),
    ({"count": NAN, "speed": 80}, r"station\.count must be a finite number >= 0, got nan"),
    ({"flow": NAN, "speed": 80}, r"station\.flow must be a finite number >= 0, got nan"),
    ({"count": 1, "speed": NAN}, r"station\.speed must be a finite number >= 0, got nan"),
    ({"count": 1, "speed": -5}, r"station\.speed must be a finite number >= 0, got -5"),
    ({"count": 1, "speed": "80"}, r"station\.speed must be a finite number >= 0, got '80'"),
    ({"count": 0, "seconds": 0}, r"station\.seconds must be an integer in 10\.\.600, got 0"),
    ({"count": 0, "seconds": 601}, r"station\.seconds must be an integer .*, got 601"),
    ({"count": 0, "seconds": 20.5}, r"station\.seconds must be an integer .*, got 20\.5"),
    ({"count": 0, "km": -0.1}, r"seen\.start must be a number in \[0, 10000\], got -0\.1"),
    ({"count": 0, "km": NAN}, r"seen\.start must be a number in \[0, 10000\], got nan"),
    ({"count": 0, "until": 1.5}, r"seen\.until must be an integer or None, got 1\.5"),
    ({"count": 0, "ramp": "on"}, r"seen\.ramp must be an integer or None, got 'on'"),
    ({"count": 1e9, "speed": 1}, r"seen\.flow must be a number in \[0, 100000\] or None"),
]


def test_a_reading_that_cannot_be_is_refused():
    for changes, message in READINGS:
        with pytest.raises(ValueError, match=f"^{message}"):
            station(**READING | changes)


PROBES = [
    ({"vehicles": 0}, r"probes\.vehicles must be an integer in 1\.\.1000000, got 0"),
    ({"vehicles": 10**400}, r"probes\.vehicles must be an integer in .*, got an integer of 400 "),
    ({"spread": 0}, r"probes\.spread must be a number in \(0, 1000\), got 0"),
    ({"speed": NAN}, r"seen\.speed must be a number in \[0, 1000\] or None, got nan"),
    ({"start": 0.3}, r"seen\.end must be >= start, 0\.3 km, got 0\.2"),
]


def test_probes_that_cannot_be_are_refused():
    sound = {"start": 0.0, "end": 0.2, "speed": 80.0, "vehicles": 3, "seconds": 60}
    for changes, message in PROBES:
        with pytest.raises(ValueError, match=f"^{message}"):
            probes(**sound | changes)


VALUES = [
    ({}, r"seen\.speed must be a number where there is no density, got None"),
    ({"speed": 80}, r"seen\.speed_std must be a number where speed is one, .* got None"),
    ({"speed": 80, "speed_std": 0}, r"seen\.speed_std must be a number in \[0\.001, 1"),
    ({"density": 20, "density_std": -1}, r"seen\.density_std must be a number in \[0\.001, 1"),
    ({"flow": 900, "speed": 9}, r"seen\.end must be start, 0 km, got 0\.1"),
    ({"end": 0.0, "flow": 9, "speed": 9, "speed_std": 9}, r"seen\.flow must be None where .* 9"),
    ({"end": 0.0, "flow": 900}, r"seen\.speed must be a number where vehicles passed, got None"),
    ({"speed_std": 5}, r"seen\.speed_std must be a number where speed is one, .* got 5"),
]


def test_values_and_deviations_come_together():
    for values, message in VALUES:
        with pytest.raises(ValueError, match=f"^{message}"):
            Seen(**{"start": 0.0, "end": 0.1} | values)
