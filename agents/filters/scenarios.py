"""Scenarios to train an estimator on: environments, query policies and seeds, drawn at random.

All scenarios of a training come from `ScenarioRanges.draw`. For other roads give other ``envs``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from agents.environments import PRIVATE, make_config, parse_env
from agents.filters.highways import KINDS, draw_highway
from agents.filters.highways import Kind as HighwayKind
from agents.filters.sections import SEGMENTS, Section
from agents.play import Cell
from dptse_env.utils.validation import Interval, checked_fields, require

Kind = Literal["flows", "speeds"]
"""Kind of the numbers that are released beside densities; weights suit one kind."""
MECHANISMS: dict[Kind, tuple[str, ...]] = {
    "flows": ("capped", "paced"), "speeds": ("printed", "corrected"),
}  # fmt: skip
"""Release models of scenarios."""
SCHEDULES = (
    "round-robin", "shift-ahead", "random", "oldest-first", "static", "stale-variance",
    "largest-variance", "largest-deviation", "expected-reduction",
)  # fmt: skip
"""Query policies of scenarios; the last four follow the estimator's own deviations."""
BOUNDARIES: dict[Kind, dict[str, float]] = {
    "flows": {"true": 0.3, "nominal": 0.45, "private": 0.25},
    "speeds": {"true": 0.8, "nominal": 0.1, "private": 0.1},
}
"""Sources of the boundary inputs, and how likely each is where it is not the usual one."""
EPSILONS, CAPS = (0.5, 20.0), (24, 128)
"""Ranges of epsilon, and of the cap of ``capped``; drawn log-uniformly."""
CONNECTED = (0.05, 0.9)
"""Range of the share of connected vehicles where not all are; drawn log-uniformly."""
MISJUDGED = 0.3
"""Deviation of the logarithm of a section's published demand, in half of them."""
SHARES = 0.16, 0.36, 0.16, 0.16, 0.16
"""Shares of `KINDS` but the first: a load that moves, one half of the convoys, is learnt slowly."""
CALIBRATED = 0.6
"""Share of sections whose estimators are given parameters that were fitted to them."""
LITTLE_NOISE, HARDLY_ANY, NONE = 0.25, 1000.0, 1e4
"""Share of scenarios whose epsilon is larger, up to this one, or in one of five none at all."""
DELTAS = (0.05, 0.001)
"""Values of delta."""
CLIPS = (18.0, 51.0)
"""Range of the clip of ``paced`` [km/h]."""


def _road(**keywords: Any) -> str:
    return f"{PRIVATE} {json.dumps(keywords)}"


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
    PRIVATE,
    'dptse_env:dptse/PaperHighway-v0 {"estimator_settings": null}',
    'dptse_env:dptse/ShortHighway-v0 {"corridor": {"duration": 600}, "parameters": "published"}',
    "dptse_env:dptse/LongHighway-v0",
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
"""The roads of the package; the paper's with random incidents and another demand or other
drivers; a road of 1 km with two lanes, and one of 2 km with four."""


@dataclass(frozen=True)
class Scenario(Cell):
    """A cell with its traffic seeds, without an estimator.

    Attributes:
        section: The road, where it is a section of a highway.
    """

    seeds: tuple[int, ...] = ()
    section: Section | None = None

    @property
    def is_taught(self) -> bool:
        """True where initial weights may know such roads and noise, and so may teach."""
        is_known = self.section is None and self.keywords["privacy"]["epsilon"] <= EPSILONS[1]
        return is_known and "penetration" not in self.keywords


@dataclass(frozen=True)
class ScenarioRanges:
    """Ranges that scenarios are drawn from.

    Attributes:
        envs: Environments, each an id or an id, a space and keywords as JSON (`parse_env`).
        sections: Share of the scenarios that are on sections of highways, not in one of `envs`.
        highways: Numbers (first, stop) of these highways, of every kind.
        free: Share of the sections that are on highways of other kinds than ``queues``.
        connected: Share of those where not all vehicles are connected.
        schedules: Query schedules.
        spans: Spans of queries under ``paced``.

    Raises:
        ValueError: A share is not in [0, 1], or there is no highway.
    """

    envs: tuple[str, ...] = ROADS
    sections: Annotated[float, Interval(0, 1)] = 0.6
    highways: tuple[int, int] = (0, 64)
    free: Annotated[float, Interval(0, 1)] = 0.6
    connected: Annotated[float, Interval(0, 1)] = 0.3
    schedules: tuple[str, ...] = SCHEDULES
    spans: tuple[tuple[int, ...], ...] = ((1,), (2,), (1, 2))

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "ranges")
        first, stop = self.highways
        require(0 <= first < stop, "ranges.highways", "first and last number", self.highways)

    def draw(
        self,
        rng: np.random.Generator,
        kind: Kind,
        traffic: Sequence[int],
        n_episodes: int,
        seconds: int,
        on_section: bool,
    ) -> Scenario:
        """Draw a scenario.

        The square root of the bandwidth, from 1 to all segments, is drawn uniformly.

        Args:
            rng: Source of randomness.
            kind: What is released.
            traffic: Traffic seeds of the environments.
            n_episodes: Number of episodes.
            seconds: Length of an episode [s]; it begins anywhere in a longer record.
            on_section: Whether the road is a section of a highway.
        """
        mechanism = str(rng.choice(MECHANISMS[kind]))
        section, seeds = None, tuple(range(n_episodes))
        if on_section:
            averaged = kind == "speeds" and rng.random() < 0.5
            section = self._draw_section(rng, n_episodes, seconds, averaged)
            env, keywords, n_mainline = PRIVATE, dict[str, Any](), section.segments
        else:
            env, keywords = parse_env(str(rng.choice(self.envs)))
            corridor = make_config(env, keywords).corridor
            n_mainline = corridor.geometry.n_mainline
            drawn = rng.choice(np.asarray(traffic), size=n_episodes, replace=False)
            seeds = tuple(int(seed) for seed in drawn)
            keywords |= {"horizon": seconds, "random_start": seconds < corridor.conditions.duration}
        if rng.random() < self.connected and not (section and section.averaged):
            share = np.exp(rng.uniform(*np.log(CONNECTED)))
            keywords["penetration"] = round(float(share), 3)
        privacy = _draw_privacy(rng, mechanism)
        if section is not None or rng.random() < 0.3:
            chances = dict(BOUNDARIES[kind])
            if section and section.averaged:
                chances["nominal"] += chances.pop("private")  # a field has no vehicles to protect
            source = rng.choice(list(chances), p=list(chances.values()))
            privacy["boundary_inputs"] = str(source)
        largest = n_mainline
        if mechanism == "paced":
            spans = self.spans[int(rng.integers(len(self.spans)))]
            if spans != (1,):
                keywords |= {"query_spans": list(spans), "bandwidth_unit": "sums"}
                largest = max(2 * n_mainline // 3, 1)
        bandwidth = 1 + int(largest * rng.random() ** 2)
        return Scenario(
            env=env,
            keywords={**keywords, "privacy": privacy, "bandwidth": bandwidth},
            policy=str(rng.choice(self.schedules)),
            seeds=seeds,
            noise_seed=int(rng.integers(10**6, 2 * 10**6)),
            section=section,
        )

    def _draw_section(
        self, rng: np.random.Generator, windows: int, seconds: int, averaged: bool
    ) -> Section:
        kind: HighwayKind = "queues"
        if rng.random() < self.free:
            kind = KINDS[1:][int(rng.choice(len(SHARES), p=SHARES))]
        number = int(rng.integers(*self.highways))
        whole = draw_highway(number, kind).corridor.geometry
        most = min(whole.n_mainline - 2, SEGMENTS[1])
        fewest = SEGMENTS[0]
        segments = int(np.exp(rng.uniform(np.log(fewest), np.log(min(20, most) + 1.0))))
        if rng.random() < (0.1 if kind == "queues" else 0.4):
            segments = most
        n_sensors = int(rng.choice([0, 1, 2, 3], p=[0.6, 0.2, 0.1, 0.1]))
        sensors = rng.choice(segments, size=n_sensors, replace=False)
        misjudged = float(np.exp(rng.normal(0.0, MISJUDGED))) if rng.random() < 0.5 else 1.0
        return Section(
            number,
            segments,
            windows,
            seconds,
            averaged=int(rng.integers(3, 11)) if averaged else 0,
            sensors=tuple(int(each) for each in sensors),
            seed=int(rng.integers(2**31)),
            kind=kind,
            misjudged=round(misjudged, 3),
            calibrated=bool(rng.random() < CALIBRATED),
        )


def _draw_privacy(rng: np.random.Generator, mechanism: str) -> dict[str, Any]:
    range_of = (EPSILONS[1], HARDLY_ANY) if rng.random() < LITTLE_NOISE else EPSILONS
    epsilon = round(float(np.exp(rng.uniform(*np.log(range_of)))), 3)
    if range_of != EPSILONS and rng.random() < 0.2:
        epsilon = NONE
    privacy: dict[str, Any] = {
        "preset": mechanism,
        "epsilon": epsilon,
        "delta": float(rng.choice(DELTAS)),
    }
    if mechanism == "capped":
        privacy["cap"] = int(np.exp(rng.uniform(*np.log(CAPS))))
    elif mechanism == "paced":
        privacy["clip"] = round(float(rng.uniform(*CLIPS)), 1)
    return privacy
