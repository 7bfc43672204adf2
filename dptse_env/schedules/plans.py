"""Open-loop schedules that were optimised on training traffic, and their files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from dptse_env.config import EnvConfig
from dptse_env.estimators import ESTIMATORS
from dptse_env.process import QueryProcess
from dptse_env.schedules.base import Schedule, require_plain
from dptse_env.utils.arrays import BoolArray, IntArray, Observation
from dptse_env.utils.json_object import parse_object, shipped_texts

PLANS = ("best-static", "optimised-plan")
"""Kinds of plans: a single set, or a periodic sequence of sets."""


@dataclass(frozen=True)
class PlanContext:
    """The road, traffic, estimator and bandwidth that a plan was optimised for."""

    corridor: str  # name of the road
    digest: str  # of its traffic, `dptse_env.traffic.Corridor.digest`
    estimator: str  # name of the estimator
    bandwidth: int  # queries per step

    @classmethod
    def from_config(cls, config: EnvConfig) -> PlanContext:
        """Return the context of a configuration."""
        corridor, estimator = config.corridor, ESTIMATORS.name_of(config.estimator)
        return cls(corridor.name, corridor.digest, estimator, config.bandwidth)

    def __str__(self) -> str:
        """Return the context in one line."""
        return (
            f"{self.corridor} (traffic {self.digest[:8]}), {self.estimator}, "
            f"bandwidth {self.bandwidth}"
        )


@dataclass(frozen=True)
class Plan:
    """A periodic sequence of sets of segments."""

    kind: str  # one of `PLANS`
    context: PlanContext
    sets: tuple[tuple[int, ...], ...]  # segments of each step of the period
    provenance: Mapping[str, Any]  # traffic, noise, scores, date and versions

    @property
    def name(self) -> str:
        """Name of the file it ships in, without the suffix."""
        road, estimator = self.context.corridor, self.context.estimator
        parts = self.kind, road, self.context.digest[:8], estimator, f"b{self.context.bandwidth}"
        return "-".join(parts)


@cache
def available_plans() -> Mapping[str, Plan]:
    """Return the plans that ship with the package, by name."""
    texts = shipped_texts("dptse_env.schedules", "plans")
    plans = [_parse(text, name) for name, text in texts.items()]
    return MappingProxyType({plan.name: plan for plan in plans})


def find_plan(kind: str, context: PlanContext) -> Plan:
    """Return the shipped plan of a kind for a context.

    Raises:
        ValueError: There is none; the message lists the available ones.
    """
    of_kind = [plan for plan in available_plans().values() if plan.kind == kind]
    for plan in of_kind:
        if plan.context == context:
            return plan
    known = "; ".join(str(plan.context) for plan in of_kind) or "none at all"
    raise ValueError(
        f"no plan {kind!r} ships for {context}; plans exist for: {known}. The file of another plan "
        "can be passed as the schedule"
    )


def read_plan(path: str | Path) -> Plan:
    """Read a plan from a JSON file, as written by `write_plan`.

    Raises:
        ValueError: The file has another format; the message starts with its path.
    """
    return _parse(Path(path).read_bytes(), str(path))


def write_plan(path: str | Path, plan: Plan) -> None:
    """Write a plan as JSON, with a line per set.

    Raises:
        ValueError: The plan could not be read back; nothing is written then.
    """
    head = {"kind": plan.kind, **vars(plan.context), "provenance": dict(plan.provenance)}
    rows = ",\n".join(f"    {json.dumps(list(segments))}" for segments in plan.sets)
    text = json.dumps(head, indent=2)[:-2] + f',\n  "sets": [\n{rows}\n  ]\n}}\n'
    _parse(text, str(path))
    Path(path).write_text(text, encoding="utf-8")


class Planned(Schedule):
    """Queries the sets of a plan periodically: an open-loop schedule.

    The plan was optimised for the mean reward on training traffic, with a certain estimator. It may
    be used with another estimator, but not with another road, traffic or bandwidth.
    """

    name: ClassVar[str] = "plan"

    def __init__(self, process: QueryProcess, plan: Plan, seed: int | None = None) -> None:
        """Bind the schedule.

        Raises:
            ValueError: The plan was made for another corridor or bandwidth, or options are not the
                mainline segments.
        """
        super().__init__(process.interface, seed)
        require_plain(process.interface, plan.kind)
        made_for, context = plan.context, PlanContext.from_config(process.config)
        if (made_for.digest, made_for.bandwidth) != (context.digest, context.bandwidth):
            raise ValueError(
                f"plan {plan.name} was made for {made_for}; the environment is {context}"
            )
        last = max(map(max, plan.sets))
        if last >= self.n_mainline:
            raise ValueError(
                f"plan {plan.name}: sets[{_first_with(plan, last)}] has segment {last}, the road "
                f"has {self.n_mainline} segments"
            )
        self.plan = plan
        self._sets = self.mask(np.array(plan.sets, dtype=np.int64))

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        chosen: BoolArray = self._sets[step % len(self._sets)]
        return chosen


_KEYS = {
    "kind": str, "corridor": str, "digest": str, "estimator": str, "bandwidth": int,
    "provenance": dict, "sets": list,
}  # fmt: skip


def _first_with(plan: Plan, segment: int) -> int:
    """Return the first step that queries a segment."""
    return next(i for i, segments in enumerate(plan.sets) if segment in segments)


def _parse(text: str | bytes, path: str) -> Plan:
    content = parse_object(text, path, _KEYS)
    kind = content["kind"]
    if kind not in PLANS:
        raise ValueError(f"{path}: kind must be one of {', '.join(PLANS)}, got {kind!r}")
    keys = ("corridor", "digest", "estimator", "bandwidth")
    context = PlanContext(*(content[key] for key in keys))
    sets = tuple(
        _checked_set(segments, context.bandwidth, f"{path}: sets[{i}]")
        for i, segments in enumerate(content["sets"])
    )
    if not sets or (kind == "best-static" and len(sets) != 1):
        raise ValueError(f"{path}: sets must hold a period, got {len(sets)} sets")
    return Plan(kind, context, sets, content["provenance"])


def _checked_set(segments: Any, bandwidth: int, path: str) -> tuple[int, ...]:
    """Return a set of segments, refused unless it is ``bandwidth`` distinct indices."""
    is_set = isinstance(segments, list) and all(type(s) is int and s >= 0 for s in segments)
    if not is_set or len(set(segments)) != len(segments) or len(segments) != bandwidth:
        raise ValueError(f"{path} must be {bandwidth} distinct segments, got {segments!r}")
    return tuple(sorted(segments))
