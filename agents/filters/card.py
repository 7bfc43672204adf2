"""Card of a trained network: what it was trained on, and where it holds."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from agents.environments import make_config, parse_env
from agents.filters.plan import FilterPlan
from dptse_env.estimators.recurrent import FORMAT
from dptse_env.estimators.recurrent_kernels import CHANNELS
from dptse_env.parts import make_task


def make_card(plan: FilterPlan, done: int, name: str) -> dict[str, Any]:
    """Return the card of a network after `done` passes of a plan."""
    ranges = plan.ranges
    configs = [
        make_config(env, {**keywords, "privacy": mechanism})
        for env, keywords in map(parse_env, ranges.envs)
        for mechanism in ranges.mechanisms
    ]
    roads = [config.corridor for config in configs]
    lanes = [count for road in roads for count in road.segment_lanes]
    found: dict[str, list[float]] = {
        "n_mainline": [road.n_mainline for road in roads],
        "segment_length": [length for road in roads for length in road.segment_lengths],
        "speed_limit": [limit for road in roads for limit in road.speed_limits],
        "lanes": [float(count) for count in lanes],
        "span": [1.0, *(float(span) for spans in ranges.spans for span in spans)],
        "flows": [float(make_task(config).releases_flow) for config in configs],
    }
    return {
        "name": name,
        "format": FORMAT,
        "channels": list(CHANNELS),
        "ranges": {key: [min(values), max(values)] for key, values in found.items()},
        "training": {
            "plan": plan.settings(),
            "passes": done,
            "versions": {each: version(each) for each in ("dptse-env", "torch", "numpy")},
        },
    }
