"""The suites: versioned lists of cells, each an environment with fixed traffic and noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from agents.environments import make_config, quietly
from agents.evaluation.episodes import WARM_UP
from agents.seeds import SUITE
from dptse_env.config import EnvConfig, parse_seeds
from dptse_env.estimators.learned.weights import member_for, read_network
from dptse_env.parts import flow_centre
from dptse_env.utils.digests import json_digest
from dptse_env.utils.validation import require_name

PAPER, PRIVATE = "dptse_env:dptse/PaperHighway-v0", "dptse_env:dptse/PrivateHighway-v0"
PACED, SHORT = "dptse_env:dptse/PrivateHighway-v1", "dptse_env:dptse/ShortHighway-v0"
LONG = "dptse_env:dptse/LongHighway-v0"
ZERO, ONE = "paper", "oracle-error"
"""Schedules of the normalised scores 0 and 1: the paper's, and the error oracle."""


@dataclass(frozen=True)
class SuiteCell:
    """An environment in which policies are scored.

    Attributes:
        name: Name in tables and cards.
        description: The road, the release model, the estimator and the bandwidth.
        env: Environment id.
        keywords: Keywords of the environment but for the action encoding, which is the policy's.
        seeds: Traffic seeds, first:stop; noise is seeded with `SUITE.start` plus the traffic seed.
    """

    name: str
    description: str
    env: str
    keywords: Mapping[str, Any] = field(hash=False)
    seeds: str

    @property
    def traffic_seeds(self) -> tuple[int, ...]:
        """The traffic seeds one by one."""
        return parse_seeds(self.seeds)

    @property
    def noise_seeds(self) -> tuple[int, ...]:
        """Seeds of noise and estimator, one for each traffic seed."""
        return tuple(SUITE.start + seed for seed in self.traffic_seeds)

    @cached_property
    def config(self) -> EnvConfig:
        """The configuration of the cell, with the default action encoding."""
        with quietly():
            return make_config(self.env, {**self.keywords, "traffic_seeds": self.seeds})

    @cached_property
    def digest(self) -> str:
        """Digest of what errors depend on: traffic, seeds, release, estimator and reward."""
        config = self.config
        content = {
            "env": self.env,
            "keywords": self.keywords,
            "seeds": [self.traffic_seeds, self.noise_seeds],
            "corridor": config.corridor.digest,
            "sensors": config.corridor.fixed_sensors,
            "scales": [config.corridor.density_scale, config.corridor.speed_scale],
            "horizon": config.horizon_steps,
            "bandwidth": config.bandwidth,
            "privacy": dataclasses.asdict(config.privacy),
            "settings": dataclasses.asdict(config.settings()),
            "networks": _network_digests(config),
            "parameters": dataclasses.asdict(config.arz_parameters),
            "warm_up": WARM_UP,
        }
        return json_digest(content)[:16]


def _network_digests(config: EnvConfig) -> list[str]:
    """Return the digest of the network that a learned estimator reads, if it is one."""
    if config.estimator != "recurrent":
        return []
    flows = flow_centre(config) is not None
    return [read_network(member_for(config.settings().recurrent.weights, flows)).sha256]


@dataclass(frozen=True)
class Suite:
    """A versioned list of cells; a change of what a cell measures makes a new version."""

    name: str
    cells: tuple[SuiteCell, ...]

    def cell(self, name: str) -> SuiteCell:
        """Return a cell by its name.

        Raises:
            ValueError: There is none.
        """
        cells = {cell.name: cell for cell in self.cells}
        require_name("cell", name, cells)
        return cells[name]


ROAD_SEEDS, LONG_SEEDS = "2500:2548", "2500:2516"
"""Test traffic seeds of no study: of roads of 15 segments or fewer, and of the long road."""

_TWO_PEAKS = {
    "base": {
        "mainline": [[0.0, 5000.0], [120.0, 2000.0], [300.0, 5600.0], [420.0, 3000.0]],
        "on_ramps": [150.0, 600.0],
    }
}


def _cell(
    name: str, description: str, env: str, seeds: str = ROAD_SEEDS, **keywords: Any
) -> SuiteCell:
    return SuiteCell(name, description, env, keywords, seeds)


def _long(name: str, description: str, **keywords: Any) -> SuiteCell:
    return _cell(name, description, LONG, LONG_SEEDS, **keywords)


_CAPPED = {"preset": "capped", "epsilon": 5.0, "cap": 64}

_FIRST = (
    _cell(
        "paper", "PaperHighway-v0, noise as printed, EKF, B = 5", PAPER,
        estimator="ekf", bandwidth=5,
    ),
    _cell(
        "capped-ekf-5", "PrivateHighway-v0, EKF, B = 5", PRIVATE,
        estimator="ekf", bandwidth=5,
    ),
    _cell(
        "capped-recurrent-5", "PrivateHighway-v0, recurrent, B = 5", PRIVATE,
        estimator="recurrent", bandwidth=5,
    ),
    _cell(
        "paced-ekf-2", "PrivateHighway-v1, EKF, B = 2", PACED,
        estimator="ekf", bandwidth=2,
    ),
    _cell(
        "paced-recurrent-2", "PrivateHighway-v1, recurrent, B = 2", PACED,
        estimator="recurrent", bandwidth=2,
    ),
    _cell(
        "paced-recurrent-5", "PrivateHighway-v1, recurrent, B = 5", PACED,
        estimator="recurrent", bandwidth=5,
    ),
    _cell(
        "other-drivers", "paced-recurrent-2 with drivers by Krauss and two peaks of demand",
        PACED, estimator="recurrent", bandwidth=2, demand=_TWO_PEAKS,
        corridor={"drivers": {"model": "Krauss"}},
    ),
    _cell(
        "short", "ShortHighway-v0, paced, recurrent, B = 1", SHORT,
        estimator="recurrent", bandwidth=1, privacy={"preset": "paced", "epsilon": 5.0},
        parameters="w99-3lane",
    ),
    _long(
        "long-capped-recurrent-8", "LongHighway-v0, capped, recurrent, B = 8",
        estimator="recurrent", bandwidth=8, privacy=_CAPPED,
    ),
    _long(
        "long-recurrent-8", "LongHighway-v0, recurrent, B = 8",
        estimator="recurrent", bandwidth=8,
    ),
    _long("long-ekf-4", "LongHighway-v0, EKF, B = 4", estimator="ekf", bandwidth=4),
    _long(
        "long-recurrent-2", "LongHighway-v0, recurrent, B = 2",
        estimator="recurrent", bandwidth=2,
    ),
)  # fmt: skip

_CONNECTED = _cell(
    "connected-recurrent-5",
    "paced-recurrent-5 with one vehicle in ten connected, and detectors on segments 3, 7 and 11",
    PACED,
    estimator="recurrent",
    bandwidth=5,
    penetration=0.1,
    corridor={"fixed_sensors": [3, 7, 11]},
)

SUITES = {
    suite.name: suite
    for suite in (
        Suite("query-suite-v1", _FIRST),
        Suite("query-suite-v2", (*_FIRST, _CONNECTED)),
    )
}
"""The suites by name."""


def find_suite(name: str) -> Suite:
    """Return a suite by its name.

    Raises:
        ValueError: There is none.
    """
    require_name("suite", name, SUITES)
    return SUITES[name]
