"""Scenarios to learn an estimator from: environments, query policies and seeds, drawn at random.

A training takes its scenarios from `ScenarioRanges.draw` alone: other roads are other ``envs``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agents.environments import make_config, parse_env
from dptse_env.utils.fields import require

MECHANISMS = ("capped", "paced", "paper", "corrected")
"""Release models that scenarios draw from."""
SCHEDULES = (
    "round-robin", "paper", "random", "oldest-first", "static", "stale-variance",
    "largest-variance", "largest-deviation",
)  # fmt: skip
"""Query policies that scenarios draw from; the last three follow the estimator's own deviations."""


_PRIVATE = "dptse_env:dptse/PrivateHighway-v1"


def _road(**keywords: Any) -> str:
    return f"{_PRIVATE} {json.dumps(keywords)}"


def _other_road(n_mainline: int, lanes: int, flows: Any, at_ramps: Any, **fields: Any) -> str:
    return _road(
        corridor={
            "n_mainline": n_mainline,
            "lanes": lanes,
            "average_dwell": 10.0,
            "demand": {"base": {"mainline": flows, "on_ramps": at_ramps}},
            "incident": {"segments": tuple(range(n_mainline - 1))},
            **fields,
        }
    )


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
    _other_road(
        10, 2, ((0.0, 1500.0), (150.0, 3600.0), (500.0, 2000.0)), (400.0,),
        on_ramps=(2,), off_ramps=(7,), exit_shares=(0.15,), fixed_sensors=(9, 11),
    ),
    _other_road(
        20, 4, ((0.0, 3500.0), (150.0, 7600.0), (450.0, 4000.0)), (350.0, 350.0),
        on_ramps=(4, 12), off_ramps=(8, 16), fixed_sensors=(19, 22, 23),
    ),
)  # fmt: skip
"""The three roads of the package; the paper's with random incidents and another demand or
other drivers; a road of 1 km with two lanes, and one of 2 km with four."""


@dataclass(frozen=True)
class Scenario:
    """One environment with a query policy, played on several traffic seeds.

    Attributes:
        env: Environment id.
        keywords: Keywords of the environment, without estimator and traffic seeds.
        schedule: Query schedule.
        traffic_seeds: Traffic seeds.
        noise_seed: Noise and estimators are seeded with this plus the traffic seed.
    """

    env: str
    keywords: dict[str, Any] = field(hash=False)
    schedule: str
    traffic_seeds: tuple[int, ...]
    noise_seed: int


@dataclass(frozen=True)
class ScenarioRanges:
    """Ranges that scenarios are drawn from.

    Attributes:
        envs: Environments, each an id or an id, a space and keywords as JSON (`parse_env`).
        mechanisms: Release models, each as often as the others.
        schedules: Query schedules.
        epsilon: Range of epsilon, drawn evenly in its logarithm.
        deltas: Values of delta.
        caps: Range of the cap of ``capped``, drawn evenly in its logarithm.
        clips: Range of the clip of ``paced`` [km/h].
        paces: Range of the pace of ``paced``.
        spans: Spans of queries under ``paced``.
        largest_share: Largest bandwidth as a share of the segments.

    Raises:
        ValueError: The share is not in (0, 1].
    """

    envs: tuple[str, ...] = ROADS
    mechanisms: tuple[str, ...] = MECHANISMS
    schedules: tuple[str, ...] = SCHEDULES
    epsilon: tuple[float, float] = (0.5, 20.0)
    deltas: tuple[float, ...] = (0.05, 0.001)
    caps: tuple[int, int] = (24, 128)
    clips: tuple[float, float] = (18.0, 51.0)
    paces: tuple[float, float] = (0.7, 0.95)
    spans: tuple[tuple[int, ...], ...] = ((1,), (2,), (1, 2))
    largest_share: float = 1.0

    def __post_init__(self) -> None:
        """Check values."""
        within = 0.0 < self.largest_share <= 1.0
        require(within, "ranges.largest_share", "in (0, 1]", self.largest_share)

    def draw(self, rng: np.random.Generator, traffic: Sequence[int], n_episodes: int) -> Scenario:
        """Draw a scenario on `n_episodes` of the traffic seeds.

        The bandwidth is drawn from 1 to all segments, or to a share of them.
        """
        env, keywords = parse_env(str(rng.choice(self.envs)))
        n_mainline = make_config(env, keywords).corridor.n_mainline
        most = max(int(self.largest_share * n_mainline), 1)
        mechanism = str(rng.choice(self.mechanisms))
        low, high = np.log(self.epsilon)
        privacy: dict[str, Any] = {
            "preset": mechanism,
            "epsilon": round(float(np.exp(rng.uniform(low, high))), 3),
            "delta": float(rng.choice(self.deltas)),
        }
        keywords |= {"privacy": privacy, "bandwidth": int(rng.integers(1, most + 1))}
        if mechanism == "capped":
            low, high = np.log(self.caps)
            privacy["cap"] = int(np.exp(rng.uniform(low, high)))
        elif mechanism == "paced":
            privacy["clip"] = round(float(rng.uniform(*self.clips)), 1)
            privacy["pace"] = round(float(rng.uniform(*self.paces)), 3)
            spans = self.spans[int(rng.integers(len(self.spans)))]
            if spans != (1,):
                keywords |= {"query_spans": list(spans), "bandwidth_unit": "sums"}
                keywords["bandwidth"] = int(rng.integers(1, max(2 * most // 3, 2)))
        seeds = rng.choice(np.asarray(traffic), size=n_episodes, replace=False)
        return Scenario(
            env=env,
            keywords=keywords,
            schedule=str(rng.choice(self.schedules)),
            traffic_seeds=tuple(int(seed) for seed in seeds),
            noise_seed=int(rng.integers(10**6, 2 * 10**6)),
        )
