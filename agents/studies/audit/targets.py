"""Targets of the adversary: the vehicles whose data distinguish two worlds best."""

from __future__ import annotations

import numpy as np

from agents.studies.audit.distances import protects_seconds, replaces
from agents.studies.audit.gaussian_planner import GaussianPlanner
from agents.studies.audit.paced_planner import PacedPlanner
from agents.studies.audit.pair_planner import PairPlanner
from agents.studies.audit.planning import Pair, Planner
from agents.studies.audit.releases import AttackedGaussian, AttackedPaced, AttackedPair, attacked
from agents.studies.audit.strategies import FixedQueries
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.config import EnvConfig
from dptse_env.parts import make_release
from dptse_env.traffic import Record
from dptse_env.utils.validation import require

PLANNERS: dict[type, type[Planner]] = {
    AttackedGaussian: GaussianPlanner,
    AttackedPaced: PacedPlanner,
    AttackedPair: PairPlanner,
}
"""Planners by the way a release model is attacked."""

TARGET_KINDS = PacedPlanner.kinds
"""Kinds of targets; release models other than the paced ledger have some of them."""

SHORTLIST = 12
"""Partners to try for the best vehicle. The best partners stand in one jam and are alike, so the
list grows sparser down the ranking instead of ending early."""


def make_planner(config: EnvConfig, policy: str) -> Planner:
    """Return what plans an attack on a configuration by a policy."""
    return PLANNERS[type(attacked(make_release(config)))](config, policy)


def make_policy(config: EnvConfig, policy: str, worlds: AdjacentWorlds) -> FixedQueries:
    """Return the policy of a name in `STRATEGIES` for two worlds."""
    return make_planner(config, policy).queries(worlds)


def choose_target(config: EnvConfig, record: Record, kind: str, policy: str) -> AdjacentWorlds:
    """Return the two worlds of a kind that a policy distinguishes best.

    Args:
        config: The configuration under attack.
        record: The traffic.
        kind: ``deleted``, a vehicle of the record is there or not; ``replaced``, one of two
            vehicles of the record is there; ``worst-case``, a vehicle is added that stands still,
            and in the other world stands elsewhere, drives by or is absent, whichever is worst
            under the adjacency. For the paced ledger also ``opposite``, the part of the worst case
            with two added vehicles on one segment, as slow and as fast as can be; and, of the
            record and replaced by another or by none, ``runs-out``, the vehicle to which its ledger
            refuses most, ``jam``, the one that stands longest, and ``late``, the one that pays most
            of those that enter in the second half.
        policy: Name of the policy.

    Raises:
        ValueError: The kind does not go with the release model or the adjacency, or the record
            holds too few vehicles.
    """
    planner = make_planner(config, policy)
    planner.require_kind(kind)
    if kind in planner.made_up_kinds:
        made_up = planner.made_up(record, kind).items()
        candidates = [_worlds(planner, record, pair, name) for name, pair in made_up]
    else:
        candidates = _of_record(planner, record, kind)
    return max(candidates, key=planner.reached) if len(candidates) > 1 else candidates[0]


def _of_record(planner: Planner, record: Record, kind: str) -> list[AdjacentWorlds]:
    """Return worlds in which the best vehicle of a kind is replaced by others, or by none."""
    ranked = planner.rank(record, kind)
    alone = kind == "deleted" or not replaces(planner.config)
    need = 1 if alone else 2
    require(len(ranked) >= need, "traffic", f"a record of {need} observable vehicles", len(ranked))
    first = int(ranked[0])
    vehicle, rest = Trajectory.from_record(record, first), record.without(first)
    if alone:
        name = f"vehicle {first} of the record, or none in its place"
        return [_worlds(planner, rest, (vehicle, Trajectory.absent()), name)]
    others = np.unique(ranked[np.geomspace(1, len(ranked) - 1, SHORTLIST).astype(int)]).tolist()
    return [
        _worlds(
            planner,
            rest.without(other),
            (vehicle, Trajectory.from_record(record, other)),
            f"vehicle {first} of the record, or vehicle {other} instead",
        )
        for other in others
    ]


def _worlds(planner: Planner, rest: Record, pair: Pair, description: str) -> AdjacentWorlds:
    """Return two worlds that differ as far as is protected.

    For the unit ``event`` that is the second of the two trajectories that tells most.
    """
    if protects_seconds(planner.config):
        seen, total = planner.observable(rest), np.zeros(rest.n_steps)
        for vehicle in pair:
            told = planner.gains(rest, vehicle) * seen[vehicle.step, vehicle.segment]
            np.add.at(total, vehicle.step, told)
        best = int(np.argmax(total))
        pair = pair[0].only(pair[0].step == best), pair[1].only(pair[1].step == best)
    return AdjacentWorlds(rest, pair, description)
