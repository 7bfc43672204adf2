"""Roads that a network is trained on unless others are given."""

from __future__ import annotations

import json
from typing import Any

_PRIVATE = "dptse_env:dptse/PrivateHighway-v1"


def _road(**keywords: Any) -> str:
    return f"{_PRIVATE} {json.dumps(keywords)}"


ROADS = (
    _PRIVATE,
    "dptse_env:dptse/PaperHighway-v0",
    "dptse_env:dptse/ShortHighway-v0",
    _road(
        demand={
            "base": {
                "mainline": ((0.0, 4500.0), (250.0, 3000.0), (450.0, 5500.0)),
                "on_ramps": (500.0, 200.0),
            }
        }
    ),
    _road(
        corridor={
            "drivers": {"model": "IDM", "headway": 1.3, "speed_deviation": 0.1},
            "average_dwell": 10.25,
        }
    ),
    _road(corridor={"drivers": {"headway": 0.9, "speed_deviation": 0.15}, "average_dwell": 10.25}),
    _road(
        corridor={
            "n_mainline": 10,
            "lanes": 2,
            "on_ramps": (2,),
            "off_ramps": (7,),
            "exit_shares": (0.15,),
            "fixed_sensors": (9, 11),
            "average_dwell": 10.0,
            "demand": {
                "base": {
                    "mainline": ((0.0, 1500.0), (150.0, 3600.0), (500.0, 2000.0)),
                    "on_ramps": (400.0,),
                }
            },
            "incident": {"segments": tuple(range(9))},
        }
    ),
    _road(
        corridor={
            "n_mainline": 20,
            "lanes": 4,
            "on_ramps": (4, 12),
            "off_ramps": (8, 16),
            "fixed_sensors": (19, 22, 23),
            "average_dwell": 10.0,
            "demand": {
                "base": {
                    "mainline": ((0.0, 3500.0), (150.0, 7600.0), (450.0, 4000.0)),
                    "on_ramps": (350.0, 350.0),
                }
            },
            "incident": {"segments": tuple(range(19))},
        }
    ),
)
"""The three roads of the package; the paper's with random incidents and another demand or
other drivers; a road of 1 km with two lanes, and one of 2 km with four."""
