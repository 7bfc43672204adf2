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
    assert probes(0.0, 0.2, 80.0, vehicles=4, seconds=60, spread=0.5).speed_std == 0.25


READINGS = [
    ({"count": 10}, r"station\.speed must be .*, got None"),
    ({"flow": 10.0}, r"station\.speed must be .*, got None"),
    ({"speed": 80}, r"station\.count must be .*, got None"),
    ({"count": 1, "flow": 60, "speed": 80}, r"station\.count must be .*, got 1"),
    ({"count": -1, "speed": 80}, r"station\.count must be .*, got -1"),
    ({"flow": NAN, "speed": 80}, r"station\.flow must be .*, got nan"),
    ({"count": 1, "speed": "80"}, r"station\.speed must be .*, got '80'"),
    ({"count": 0, "seconds": 9}, r"station\.seconds must be .* 10\.\.600, got 9"),
    ({"count": 0, "seconds": 601}, r"station\.seconds must be .*, got 601"),
    ({"count": 0, "km": -0.1}, r"seen\.start must be .*, got -0\.1"),
    ({"count": 0, "until": 1.5}, r"seen\.until must be .*, got 1\.5"),
    ({"count": 0, "ramp": "on"}, r"seen\.ramp must be .*, got 'on'"),
    ({"count": 1e9, "speed": 1}, r"seen\.flow must be"),
]


PROBES = [
    ({"vehicles": 0}, r"probes\.vehicles must be .*, got 0"),
    ({"spread": 0}, r"probes\.spread must be .*, got 0"),
    ({"speed": NAN}, r"seen\.speed must be .*, got nan"),
    ({"start": 0.3}, r"seen\.end must be .*, got 0\.2"),
]


VALUES = [
    ({}, r"seen\.speed must be .*, got None"),
    ({"speed": 80}, r"seen\.speed_std must be .*, got None"),
    ({"speed": 80, "speed_std": 0}, r"seen\.speed_std must be .*, got 0"),
    ({"density": 20, "density_std": -1}, r"seen\.density_std must be .*, got -1"),
    ({"flow": 900, "speed": 9}, r"seen\.end must be start, .*, got 0\.1"),
    ({"end": 0.0, "flow": 9, "speed": 9, "speed_std": 9}, r"seen\.flow must be None .*, got 9"),
    ({"end": 0.0, "flow": 900}, r"seen\.speed must be .*, got None"),
    ({"speed_std": 5}, r"seen\.speed_std must be .* got 5"),
]


SEGMENT = {"start": 0.0, "end": 0.1}
STRETCH = {"start": 0.0, "end": 0.2, "speed": 80.0, "vehicles": 3, "seconds": 60}


@pytest.mark.parametrize(
    ("make", "sound", "bad"),
    [(station, READING, READINGS), (probes, STRETCH, PROBES), (Seen, SEGMENT, VALUES)],
)
def test_what_cannot_be_is_refused(make, sound, bad):
    for changes, message in bad:
        with pytest.raises(ValueError, match=f"^{message}"):
            make(**sound | changes)
