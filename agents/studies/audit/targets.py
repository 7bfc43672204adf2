"""Targets of the adversary: the vehicles whose data distinguish two worlds best."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from agents.studies.audit.attack import planned_distance
from agents.studies.audit.distances import (
    ReleaseDistances,
    contribution_cap,
    plan_contributions,
    protects_seconds,
    replaces,
)
from agents.studies.audit.strategies import (
    PUBLIC_SCHEDULES,
    always_observed,
    make_policy,
    public_plan,
)
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.config import EnvConfig
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, IntArray
from dptse_env.utils.validation import require

TARGET_KINDS = ("worst-case", "replaced", "deleted")
"""Kinds of targets; the last two are vehicles of the record."""

SHORTLIST = 12
"""Partners to try for the best vehicle. The best partners stand in one jam and are alike, so the
list grows sparser down the ranking instead of ending early."""


def choose_target(config: EnvConfig, record: Record, kind: str, policy: str) -> AdjacentWorlds:
    """Return the two worlds of a kind that a policy distinguishes best.

    Args:
        config: The configuration under attack.
        record: The traffic.
        kind: ``deleted``, a vehicle of the record is there or not; ``replaced``, one of two
            vehicles of the record is there; ``worst-case``, a vehicle is added that stands still,
            and in the other world stands elsewhere, drives by or is absent, whichever is worst
            under the adjacency.
        policy: Name of the policy.

    Raises:
        ValueError: The kind does not go with the adjacency, or the record holds too few vehicles.
    """
    require(kind in TARGET_KINDS, "target", f"one of {list(TARGET_KINDS)}", kind)
    if kind == "worst-case":
        return _worst_case(config, record, policy)
    replace = replaces(config)
    require(
        replace or kind == "deleted", "target", "'deleted' or 'worst-case' with add_remove", kind
    )
    seen = _observable(config, record, policy)
    ranked = _by_reach(config, record, seen, policy)
    need = 2 if kind == "replaced" else 1
    require(len(ranked) >= need, "traffic", f"a record of {need} observable vehicles", len(ranked))
    first = int(ranked[0])
    vehicle = Trajectory.from_record(record, first)
    if kind == "deleted":
        pair = _protected(config, record, seen, (vehicle, Trajectory.absent()))
        description = f"vehicle {first} of the record, or none in its place"
        return AdjacentWorlds(record.without(first), pair, description)
    candidates = []
    for other in np.unique(ranked[np.geomspace(1, len(ranked) - 1, SHORTLIST).astype(int)]):
        rest = record.without(first).without(other)
        partner = Trajectory.from_record(record, other)
        pair = _protected(config, rest, seen, (vehicle, partner))
        description = f"vehicle {first} of the record, or vehicle {other} instead"
        candidates.append(AdjacentWorlds(rest, pair, description))
    return max(candidates, key=lambda worlds: _reached(config, worlds, policy))


def _observable(config: EnvConfig, record: Record, policy: str) -> BoolArray:
    """Return flags of record columns the policy may observe, (n_steps, n_columns)."""
    corridor, horizon = config.corridor, config.horizon_steps
    observed = np.zeros((record.n_steps, record.n_columns), dtype=bool)
    queried = public_plan(config, policy) if policy in PUBLIC_SCHEDULES else True
    observed[1 : horizon + 1, : corridor.n_mainline] = queried
    observed[1 : horizon + 1, always_observed(config)] = True
    return observed


def _by_reach(config: EnvConfig, record: Record, seen: BoolArray, policy: str) -> IntArray:
    """Return vehicles by the distance between presence and absence, the largest first."""
    rows = np.flatnonzero(seen[record.step, record.segment])
    rows = rows[np.lexsort((record.step[rows], record.vehicle[rows]))]
    gains = ReleaseDistances.from_config(config).by_row(record)[rows]
    always = np.isin(record.segment[rows], always_observed(config))
    # A schedule meets a vehicle when it does; a hunter picks the seconds that reveal most.
    always |= policy in PUBLIC_SCHEDULES
    vehicles, starts = np.unique(record.vehicle[rows].astype(np.int64), return_index=True)
    reach = np.zeros(len(vehicles))
    for i, (start, stop) in enumerate(pairwise([*starts.tolist(), len(rows)])):
        trip = slice(start, stop)
        if protects_seconds(config):
            reach[i] = gains[trip].max()
        else:
            cap = contribution_cap(config)
            reach[i] = plan_contributions(gains[trip], always[trip], cap).reach
    best: IntArray = vehicles[np.argsort(-reach, kind="stable")]
    return best


def _reached(config: EnvConfig, worlds: AdjacentWorlds, policy: str) -> float:
    plan = make_policy(config, policy, worlds).plan
    return planned_distance(config, worlds, plan, ReleaseDistances.from_config(config).sigma)


def _worst_case(config: EnvConfig, record: Record, policy: str) -> AdjacentWorlds:
    """Return the two trajectories of the closed form that are furthest apart."""
    corridor, seconds = config.corridor, np.arange(1, config.horizon_steps + 1)
    load = record.counts[:, : corridor.n_mainline].sum(axis=0)
    fixed = np.isin(np.arange(corridor.n_mainline), corridor.fixed_sensors)
    # Segments without a sensor and with few others, whose mean speed one vehicle moves most.
    here, there = (int(segment) for segment in np.lexsort((load, fixed))[:2])
    stands = Trajectory.constant(seconds, here, 0.0)
    alternatives = {"none in its place": Trajectory.absent()}
    if replaces(config):
        limit = corridor.speed_limit
        alternatives = {
            f"on segment {there} instead": Trajectory.constant(seconds, there, 0.0),
            f"there at {limit:g} km/h": Trajectory.constant(seconds, here, limit),
        }
    seen = _observable(config, record, policy)
    added = f"an added vehicle that stands on segment {here}"
    candidates = [
        AdjacentWorlds(
            record, _protected(config, record, seen, (stands, other)), f"{added}, or {name}"
        )
        for name, other in alternatives.items()
    ]
    return max(candidates, key=lambda worlds: _reached(config, worlds, policy))


def _protected(
    config: EnvConfig, rest: Record, seen: BoolArray, pair: tuple[Trajectory, Trajectory]
) -> tuple[Trajectory, Trajectory]:
    """Return what may differ of two trajectories: for unit `event`, their most telling second."""
    if not protects_seconds(config):
        return pair
    distances, total = ReleaseDistances.from_config(config), np.zeros(rest.n_steps)
    for vehicle in pair:
        gains = distances.by_second(rest, vehicle) * seen[vehicle.step, vehicle.segment]
        np.add.at(total, vehicle.step, gains)
    best = int(np.argmax(total))
    return pair[0].only(pair[0].step == best), pair[1].only(pair[1].step == best)
