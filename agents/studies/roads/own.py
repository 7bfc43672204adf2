"""Roads that nobody trained on, each unlike PrivateHighway-v1 in one respect or two."""

from __future__ import annotations

from typing import Any

Keywords = dict[str, Any]
"""Keywords of an environment."""


def _demand(*mainline: tuple[float, float], on_ramps: tuple[float, ...]) -> Keywords:
    return {"base": {"mainline": mainline, "on_ramps": on_ramps}}


def _peak(low: float, high: float) -> tuple[tuple[float, float], ...]:
    return (0.0, low), (200.0, high), (400.0, low)


_WAVES = tuple((100.0 + 50.0 * k, 125.0 + 50.0 * k, 8.0) for k in range(10))
"""Ten times in turn, 25 s at 8 km/h and 25 s without a limit of their own."""

OWN_ROADS: dict[str, Keywords] = {
    "two lanes, 80 km/h": {
        "corridor": {
            "lanes": 2,
            "speed_limit": 80.0,
            "average_dwell": 8.0,
            "demand": _demand(*_peak(1400.0, 4000.0), on_ramps=(250.0, 250.0)),
        }
    },
    "five lanes, 120 km/h": {
        "corridor": {
            "lanes": 5,
            "speed_limit": 120.0,
            "average_dwell": 6.9,
            "demand": _demand(*_peak(3400.0, 9800.0), on_ramps=(400.0, 400.0)),
        }
    },
    "segments of 50 m": {
        "corridor": {
            "n_mainline": 30,
            "segment_length": 0.05,
            "on_ramps": (6, 18),
            "off_ramps": (12, 24),
            "fixed_sensors": (29, 32, 33),
            "average_dwell": 3.5,
            "incident": {"segments": tuple(range(29))},
        },
        "bandwidth": 10,
    },
    "trucks, 15 %": {
        "corridor": {
            "average_dwell": 7.4,
            "vehicle_classes": (
                {"name": "car", "share": 0.85},
                {"name": "truck", "share": 0.15, "length": 12.0, "largest_speed": 85.0},
            ),
        }
    },
    "drivers by Krauss": {"corridor": {"drivers": {"model": "Krauss"}, "average_dwell": 6.3}},
    "headways of 0.6 s, mixed speeds": {
        "corridor": {"drivers": {"headway": 0.6, "speed_deviation": 0.2}, "average_dwell": 7.4}
    },
    "night, 300 veh/h": {
        "corridor": {
            "average_dwell": 3.6,
            "demand": _demand((0.0, 300.0), on_ramps=(30.0, 30.0)),
            "incident": None,
        }
    },
    "stop and go": {
        "corridor": {
            "average_dwell": 13.6,
            "demand": _demand((0.0, 4800.0), on_ramps=(320.0, 300.0)),
            "incident": {"segment": 12, "phases": _WAVES},
        }
    },
    "incident on the last segment": {
        "corridor": {"average_dwell": 6.5, "incident": {"segments": (14,)}}
    },
    "six ramps": {
        "corridor": {
            "n_mainline": 30,
            "on_ramps": (4, 14, 22),
            "off_ramps": (9, 18, 26),
            "exit_shares": (0.1, 0.1, 0.1),
            "fixed_sensors": (29, 33, 34, 35),
            "average_dwell": 5.5,
            "demand": _demand(*_peak(2050.0, 5800.0), on_ramps=(350.0, 350.0, 350.0)),
            "incident": {"segments": tuple(range(29))},
        },
        "bandwidth": 10,
    },
    "segments of 200 m": {
        "corridor": {
            "n_mainline": 10,
            "segment_length": 0.2,
            "on_ramps": (2, 6),
            "off_ramps": (4, 8),
            "fixed_sensors": (9, 12, 13),
            "average_dwell": 13.4,
            "incident": {"segments": tuple(range(9))},
        },
        "bandwidth": 3,
    },
    "lane drop, 4 to 3": {
        "corridor": {
            "lanes": (4,) * 9 + (3,) * 6,
            "average_dwell": 6.8,
            "demand": _demand(*_peak(2700.0, 7400.0), on_ramps=(320.0, 300.0)),
            "incident": None,
        }
    },
    "drivers by IDM, 100 km/h": {
        "corridor": {
            "speed_limit": 100.0,
            "drivers": {"model": "IDM", "headway": 1.4, "speed_deviation": 0.1},
            "average_dwell": 6.6,
        }
    },
    "no ramps, 90 km/h": {
        "corridor": {
            "speed_limit": 90.0,
            "on_ramps": (),
            "off_ramps": (),
            "exit_shares": (),
            "fixed_sensors": (14,),
            "average_dwell": 7.0,
            "demand": _demand(*_peak(2300.0, 6400.0), on_ramps=()),
        }
    },
}
"""Keywords by which they differ from PrivateHighway-v1."""

KEPT_BACK = (
    "segments of 200 m", "lane drop, 4 to 3", "drivers by IDM, 100 km/h", "no ramps, 90 km/h",
)  # fmt: skip
"""Roads on which nothing was chosen: they were played once, when the weights were final."""
