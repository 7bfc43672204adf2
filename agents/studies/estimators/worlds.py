"""Worlds of the study of estimators: environments with keywords."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from agents.experiments.demand import TWO_PEAKS

PAPER, PRIVATE = "dptse_env:dptse/PaperHighway-v0", "dptse_env:dptse/PrivateHighway-v0"
PACED, SHORT = "dptse_env:dptse/PrivateHighway-v1", "dptse_env:dptse/ShortHighway-v0"
SUMS = {"query_spans": [2], "bandwidth_unit": "sums"}


@dataclass(frozen=True)
class World:
    """An environment in which estimators are compared.

    Attributes:
        label: What it is, for tables.
        env: Environment id.
        keywords: Keywords of the environment.
        tampering: One of `agents.studies.estimators.tampering.TAMPERINGS`, or empty.
    """

    label: str
    env: str
    keywords: dict[str, Any] = field(default_factory=dict, hash=False)
    tampering: str = ""

    def on(self, road: Mapping[str, Any]) -> World:
        """Return this world with the keywords of a road in place of its own."""
        return dataclasses.replace(self, keywords={**self.keywords, **road})


MAIN = {
    "printed": World("`PaperHighway-v0`", PAPER),
    "corrected": World("`PaperHighway-v0`, preset `corrected`", PAPER, {"privacy": "corrected"}),
    "capped": World("`PrivateHighway-v0`", PRIVATE),
    "paced": World("`PrivateHighway-v1`", PACED),
}
"""Worlds in which every estimator meets every schedule."""

GUARANTEES = {
    "paced-sums": World("`PrivateHighway-v1`, five sums over two neighbours", PACED, SUMS),
    "paced-low": World("`PrivateHighway-v1` at ε = 1", PACED, {"epsilon": 1.0}),
    "paced-low-sums": World(
        "`PrivateHighway-v1` at ε = 1, five sums", PACED, {"epsilon": 1.0, **SUMS}
    ),
}
"""Other actions and guarantees under ``paced``."""

_LONG_DEMAND = {
    "base": {
        "mainline": [[0.0, 2500.0], [150.0, 5400.0], [500.0, 2500.0]],
        "on_ramps": [300.0, 300.0, 300.0],
    }
}
_LONG_ROAD = {
    "n_mainline": 60,
    "on_ramps": [9, 29, 49],
    "off_ramps": [19, 39, 54],
    "exit_shares": [0.1, 0.1, 0.1],
    "fixed_sensors": [59, 63, 64, 65],
    "average_dwell": 10.25,
    "demand": _LONG_DEMAND,
    "incident": {"segments": list(range(59))},
}


def _paced(label: str, tampering: str = "", **keywords: Any) -> World:
    return World(label, PACED, keywords, tampering)


def _drivers(**fields: Any) -> dict[str, Any]:
    return {"drivers": fields}


ELSEWHERE = {
    "krauss": _paced("drivers by Krauss", corridor=_drivers(model="Krauss")),
    "idm": _paced("drivers by IDM", corridor=_drivers(model="IDM")),
    "aggressive": _paced(
        "headways of 0.6 s, mixed speeds", corridor=_drivers(headway=0.6, speed_deviation=0.2)
    ),
    "cautious": _paced("headways of 2 s", corridor=_drivers(headway=2.0)),
    "free": _paced("no incident", incident="none"),
    "incident": _paced("the paper's incident", incident={
        "segment": 10, "phases": [[200.0, 400.0, 10.08], [400.0, 500.0, 50.95]],
    }),
    "two-peaks": _paced("demand with two peaks", demand=TWO_PEAKS),
    "long": _paced("a road of 6 km, B = 20", corridor=_LONG_ROAD, bandwidth=20),
    "short": World("`ShortHighway-v0`", SHORT),
    **{f"epsilon-{e:g}": _paced(f"ε = {e:g}", epsilon=e) for e in (0.5, 2.0, 10.0, 20.0)},
    **{f"bandwidth-{b}": _paced(f"B = {b}", bandwidth=b) for b in (1, 2, 10, 15)},
    "failing": _paced("fixed sensors fail from second 300 to 360", "failing"),
    "no-demand": _paced("no nominal demand among the inputs", "constant-demand"),
    "other-traffic": _paced("releases of other traffic", "other-releases"),
}  # fmt: skip
"""Worlds that differ from `PrivateHighway-v1` in one thing, most of them not trained in."""

WORLDS = {**MAIN, **GUARANTEES, **ELSEWHERE}
