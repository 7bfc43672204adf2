"""Open-loop schedules that were optimised on training traffic, and the files that they come in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dptse_env.arrays import BoolArray, IntArray, Observation
from dptse_env.config import EnvConfig
from dptse_env.process import QueryProcess
from dptse_env.schedules.base import Schedule

PLANS = ("best-static", "offline")
"""Kinds of plans: one set for all time, a period of sets."""


@dataclass(frozen=True)
class Place:
    """What a plan was made for.

    Attributes:
        corridor: Name of the road.
        digest: Digest of its traffic (`dptse_env.traffic.Corridor.digest`).
        estimator: Name of the estimator.
        bandwidth: Queries a step.
    """

    corridor: str
    digest: str
    estimator: str
    bandwidth: int

    @classmethod
    def of(cls, config: EnvConfig) -> Place:
        """Return what a configuration asks for."""
        corridor = config.corridor
        return cls(corridor.name, corridor.digest, config.estimator, config.bandwidth)

    def __str__(self) -> str:
        """Name it in one line."""
        return (
            f"{self.corridor} (traffic {self.digest[:8]}), {self.estimator}, "
            f"bandwidth {self.bandwidth}"
        )


@dataclass(frozen=True)
class Plan:
    """A period of sets of segments.

    Attributes:
        kind: One of `PLANS`.
        place: What it was made for.
        sets: The segments of each step of the period.
        provenance: Traffic, noise, scores, date and versions.
    """

    kind: str
    place: Place
    sets: tuple[tuple[int, ...], ...]
    provenance: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the file it ships in, without the suffix."""
        place = self.place
        return "-".join(
            (self.kind, place.corridor, place.digest[:8], place.estimator, f"b{place.bandwidth}")
        )


def available_plans() -> dict[str, Plan]:
    """Return the plans that ship with the package, by name."""
    return dict(_shipped())


def find_plan(kind: str, place: Place) -> Plan:
    """Return the shipped plan of a kind for a place.

    Raises:
        ValueError: There is none; the message names those that there are.
    """
    of_kind = [plan for plan in _shipped().values() if plan.kind == kind]
    for plan in of_kind:
        if plan.place == place:
            return plan
    known = "; ".join(str(plan.place) for plan in of_kind) or "none at all"
    raise ValueError(
        f"no plan {kind!r} ships for {place}; there is one for: {known}. "
        "scripts/search_plan.py makes one; pass its file as the schedule"
    )


def read_plan(path: str | Path) -> Plan:
    """Read a plan from a JSON file of the shape that `write_plan` leaves.

    Raises:
        ValueError: The file has another shape; the message starts with its path.
    """
    return _parse(Path(path).read_text(encoding="utf-8"), str(path))


def write_plan(path: str | Path, plan: Plan) -> None:
    """Write a plan as JSON, one set a line.

    Raises:
        ValueError: The plan is not one that can be read back; nothing is written then.
    """
    head = {"kind": plan.kind, **vars(plan.place), "provenance": dict(plan.provenance)}
    rows = ",\n".join(f"    {json.dumps(list(one))}" for one in plan.sets)
    text = json.dumps(head, indent=2)[:-2] + f',\n  "sets": [\n{rows}\n  ]\n}}\n'
    _parse(text, str(path))
    Path(path).write_text(text, encoding="utf-8")


class Planned(Schedule):
    """Asks what a plan says, period after period: an open-loop schedule.

    The plan was optimised on training traffic for the mean reward, under one estimator; another
    estimator may follow it, another road, traffic or bandwidth may not. It costs an index.
    """

    name: ClassVar[str] = "plan"

    def __init__(self, process: QueryProcess, plan: Plan, seed: int | None = None) -> None:
        """Bind the schedule.

        Raises:
            ValueError: The plan was made for another corridor or bandwidth.
        """
        super().__init__(process.interface, seed)
        own, place = plan.place, Place.of(process.config)
        if (own.digest, own.bandwidth) != (place.digest, place.bandwidth):
            raise ValueError(f"plan {plan.name} was made for {own}; the environment is {place}")
        last = max(max(one) for one in plan.sets)
        if last >= self.n_mainline:
            raise ValueError(
                f"plan {plan.name}: sets[{_holds(plan, last)}] asks segment {last}, the road has "
                f"{self.n_mainline}"
            )
        self.plan = plan
        self._sets = self._mask(np.array(plan.sets, dtype=np.int64))

    def select(self, step: IntArray, observation: Observation) -> BoolArray:
        """See `Schedule.select`."""
        chosen: BoolArray = self._sets[step % len(self._sets)]
        return chosen


_KEYS = {
    "kind": str, "corridor": str, "digest": str, "estimator": str, "bandwidth": int,
    "provenance": dict, "sets": list,
}  # fmt: skip


@cache
def _shipped() -> dict[str, Plan]:
    folder = resources.files("dptse_env.schedules") / "plans"
    plans = [
        _parse(entry.read_text(encoding="utf-8"), entry.name)
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name)
        if entry.name.endswith(".json")
    ]
    return {plan.name: plan for plan in plans}


def _holds(plan: Plan, segment: int) -> int:
    """Return the first step that asks a segment."""
    return next(i for i, one in enumerate(plan.sets) if segment in one)


def _parse(text: str, path: str) -> Plan:
    try:
        content = json.loads(text)
    except json.JSONDecodeError as problem:
        raise ValueError(f"{path} must be JSON: {problem}") from problem
    if not isinstance(content, dict) or set(content) != set(_KEYS):
        got = sorted(content) if isinstance(content, dict) else content
        raise ValueError(f"{path} must be a mapping with the keys {', '.join(_KEYS)}, got {got!r}")
    for key, kind in _KEYS.items():
        if not isinstance(content[key], kind) or isinstance(content[key], bool):
            raise ValueError(f"{path}: {key} must be of type {kind.__name__}, got {content[key]!r}")
    if content["kind"] not in PLANS:
        raise ValueError(f"{path}: kind must be one of {', '.join(PLANS)}, got {content['kind']!r}")
    place = Place(*(content[name] for name in ("corridor", "digest", "estimator", "bandwidth")))
    sets = tuple(
        _checked_set(one, place.bandwidth, f"{path}: sets[{i}]")
        for i, one in enumerate(content["sets"])
    )
    if not sets or (content["kind"] == "best-static" and len(sets) != 1):
        raise ValueError(f"{path}: sets must hold a period, got {len(sets)} sets")
    return Plan(content["kind"], place, sets, content["provenance"])


def _checked_set(one: Any, bandwidth: int, path: str) -> tuple[int, ...]:
    """Return one set of segments, refused if it is none of ``bandwidth`` distinct indices."""
    is_set = isinstance(one, list) and all(type(s) is int and s >= 0 for s in one)
    if not is_set or len(set(one)) != len(one) or len(one) != bandwidth:
        raise ValueError(f"{path} must be {bandwidth} distinct segments, got {one!r}")
    return tuple(sorted(one))
