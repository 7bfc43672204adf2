"""Whom the adversary looks for: the vehicle whose data tells the two worlds apart best."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agents.studies.audit.attack import planned_distance
from agents.studies.audit.distances import Ruler, best_spending
from agents.studies.audit.policies import (
    PUBLIC_SCHEDULES,
    always_observed,
    make_policy,
    public_plan,
)
from agents.studies.audit.worlds import Path, TwoWorlds
from dptse_env.arrays import BoolArray, IntArray
from dptse_env.config import EnvConfig
from dptse_env.traffic import Record
from dptse_env.validation import require

TARGETS = ("worst-case", "replaced", "deleted")
"""Kinds of targets; the last two are vehicles of the record."""

SHORTLIST = 12
"""Partners to try for the best vehicle. The best ones stand in one jam and look alike, so the list
grows sparser down the ranking instead of ending early."""


@dataclass(frozen=True)
class Target:
    """Two worlds and their difference in words."""

    worlds: TwoWorlds
    description: str


def choose_target(config: EnvConfig, record: Record, kind: str, policy: str) -> Target:
    """Return the two worlds that a policy tells apart best, among those of a kind.

    Args:
        config: The configuration under attack.
        record: The traffic.
        kind: ``deleted``, a vehicle of the record is there or not; ``replaced``, one vehicle of
            the record or another one is there; ``worst-case``, a vehicle is added that stands
            still, and in the other world stands elsewhere, drives by or is not there, as the
            adjacency has it and whichever is worst.
        policy: Name of the policy.

    Raises:
        ValueError: The kind does not go with the adjacency, or the record holds too few vehicles.
    """
    require(kind in TARGETS, "target", f"one of {list(TARGETS)}", kind)
    if kind == "worst-case":
        return _worst_case(config, record, policy)
    replace = config.privacy.adjacency == "replace"
    require(
        replace or kind == "deleted", "target", "'deleted' or 'worst-case' with add_remove", kind
    )
    seen = _observable(config, record, policy)
    ranked = _by_reach(config, record, seen, policy)
    need = 2 if kind == "replaced" else 1
    require(len(ranked) >= need, "traffic", f"a record of {need} observable vehicles", len(ranked))
    first = int(ranked[0])
    path = Path.of(record, first)
    if kind == "deleted":
        paths = _protected(config, record, seen, (path, Path.nowhere()))
        worlds = TwoWorlds(record.without(first), paths)
        return Target(worlds, f"vehicle {first} of the record, or nobody in its place")
    pairs = {}
    for other in np.unique(ranked[np.geomspace(1, len(ranked) - 1, SHORTLIST).astype(int)]):
        rest = record.without(first).without(other)
        paths = _protected(config, rest, seen, (path, Path.of(record, other)))
        pairs[int(other)] = TwoWorlds(rest, paths)
    second = max(pairs, key=lambda other: _reached(config, pairs[other], policy))
    return Target(pairs[second], f"vehicle {first} of the record, or vehicle {second} instead")


def _observable(config: EnvConfig, record: Record, policy: str) -> BoolArray:
    """Which record columns the policy may observe in each second, (n_steps, n_columns)."""
    corridor, horizon = config.corridor, config.horizon_steps
    observed = np.zeros((record.n_steps, record.n_columns), dtype=bool)
    asked = public_plan(config, policy) if policy in PUBLIC_SCHEDULES else True
    observed[1 : horizon + 1, : corridor.n_mainline] = asked
    observed[1 : horizon + 1, always_observed(config)] = True
    return observed


def _by_reach(config: EnvConfig, record: Record, seen: BoolArray, policy: str) -> IntArray:
    """Vehicles by the distance between being there and not, the largest first."""
    rows = np.flatnonzero(seen[record.step, record.segment])
    rows = rows[np.lexsort((record.step[rows], record.vehicle[rows]))]
    gains = Ruler.of(config).of_rows(record)[rows]
    unasked = np.isin(record.segment[rows], always_observed(config))
    # A schedule meets a vehicle when it does; a hunter picks the seconds that tell most.
    unasked |= policy in PUBLIC_SCHEDULES
    vehicles, starts = np.unique(record.vehicle[rows], return_index=True)
    reach = np.zeros(len(vehicles))
    for i, (start, stop) in enumerate(pairwise([*starts.tolist(), len(rows)])):
        own = slice(start, stop)
        if config.privacy.is_bounded and config.privacy.unit == "event":
            reach[i] = gains[own].max()
        else:
            cap = config.privacy.contribution_cap or config.horizon_steps
            reach[i] = best_spending(gains[own], unasked[own], cap).reach
    best: IntArray = vehicles[np.argsort(-reach, kind="stable")]
    return best


def _reached(config: EnvConfig, worlds: TwoWorlds, policy: str) -> float:
    plan = make_policy(config, policy, worlds).plan
    return planned_distance(config, worlds, plan, Ruler.of(config).sigma)


def _worst_case(config: EnvConfig, record: Record, policy: str) -> Target:
    """The two paths of the closed form that are furthest apart."""
    corridor, seconds = config.corridor, np.arange(1, config.horizon_steps + 1)
    load = record.counts[:, : corridor.n_mainline].sum(axis=0)
    fixed = np.isin(np.arange(corridor.n_mainline), corridor.fixed_sensors)
    # Segments without a sensor and with few others, whose mean speed one vehicle moves most.
    here, there = (int(segment) for segment in np.lexsort((load, fixed))[:2])
    stands = Path.constant(seconds, here, 0.0)
    others = {"nobody in its place": Path.nowhere()}
    if config.privacy.adjacency == "replace":
        limit = corridor.speed_limit
        others = {
            f"on segment {there} instead": Path.constant(seconds, there, 0.0),
            f"there at {limit:g} km/h": Path.constant(seconds, here, limit),
        }
    seen = _observable(config, record, policy)
    worlds = {
        name: TwoWorlds(record, _protected(config, record, seen, (stands, path)))
        for name, path in others.items()
    }
    worst = max(worlds, key=lambda name: _reached(config, worlds[name], policy))
    return Target(worlds[worst], f"an added vehicle that stands on segment {here}, or {worst}")


def _protected(
    config: EnvConfig, rest: Record, seen: BoolArray, paths: tuple[Path, Path]
) -> tuple[Path, Path]:
    """Cut two paths down to what may differ: the one second that tells most for unit `event`."""
    if not (config.privacy.is_bounded and config.privacy.unit == "event"):
        return paths
    ruler, total = Ruler.of(config), np.zeros(rest.n_steps)
    for path in paths:
        gains = ruler.of_path(rest, path) * seen[path.step, path.segment]
        np.add.at(total, path.step, gains)
    best = int(np.argmax(total))
    return paths[0].only(paths[0].step == best), paths[1].only(paths[1].step == best)
