"""Wrong ledgers and too little noise, as the audit sees them.

The deterministic distances of ``tests/release/test_paced_mutations.py`` catch each of them surely;
here an adversary has to find it in noisy transcripts of the decision process.
"""

import dataclasses

import numpy as np
import pytest

from agents.audit.attack import attack
from agents.audit.planner import make_policy
from agents.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.privacy import mu_of
from dptse_env.privacy.audit_statistics import Claim, audit
from dptse_env.release import Paced
from dptse_env.release.ledgers import Ledgers, Sums
from tests.release.paced_worlds import PlainLedgers
from tests.release.test_paced_mutations import ReleasedUnclipped

from .small import HORIZON, ROAD, HalfTheLimit, paced

CLAIM = Claim(mu_of(5.0, 0.05), 5.0, 0.05)
SECONDS = np.arange(1, HORIZON + 1)


class LedgerForEachSegment(Ledgers):
    def load(self, slot, record):
        accounts = record.vehicle.astype(np.int64) * record.n_columns + record.segment
        super().load(slot, dataclasses.replace(record, vehicle=accounts))


class FreeSensors(Ledgers):
    def collect(self, episodes, slots, times, observed, *public):
        free = observed & np.isin(np.arange(observed.shape[1]), ROAD.fixed_sensors)
        budget, paid = self.budget, self.paid[episodes].copy()
        self.budget = np.inf
        unpaid = super().collect(episodes, slots, times, free, *public)
        self.budget, self.paid[episodes] = budget, paid
        charged = super().collect(episodes, slots, times, observed & ~free, *public)
        return Sums(*(one + other for one, other in zip(charged, unpaid, strict=True)))


def keeping(kind):
    """The paced release with other ledgers."""

    class Mutant(Paced):
        def __init__(self, setup):
            super().__init__(setup)
            ledgers = self.ledgers
            self.ledgers = kind(
                ledgers._columns, ledgers.vehicles, setup.n_episodes,
                budget=ledgers.budget, clip=ledgers.clip, ratio=ledgers.ratio,
            )  # fmt: skip

    return Mutant


class TwiceTheBudget(Paced):
    def __init__(self, setup):
        super().__init__(setup)
        self.ledgers.budget *= 2.0


class ChargedForTheCountAlone(Paced):
    def __init__(self, setup):
        super().__init__(setup)
        self.ledgers.ratio = 0.0


class RatioOfTwo(Paced):
    def __init__(self, setup):
        object.__setattr__(setup.settings, "ratio", 2.0)
        super().__init__(setup)


def roving(offset):
    return Trajectory(SECONDS, (SECONDS + offset) % 5, np.zeros(HORIZON))


def staying(segment, speed=0.0):
    return Trajectory.constant(SECONDS, segment, speed)


# Worlds, settings, and a lower bound on the distance over mu.
BLATANT = {
    "a ledger for each segment": (
        keeping(LedgerForEachSegment), (roving(0), roving(2)), {}, 1.8
    ),
    "fixed sensors that are not charged": (
        keeping(FreeSensors), tuple(map(staying, ROAD.fixed_sensors)), {}, 1.8,
    ),
    "charged at the clipped and released at the unclipped deviation": (
        keeping(ReleasedUnclipped), (staying(1), staying(3)), {"clip": 20.0}, 1.8
    ),
}  # fmt: skip
SUBTLE = {
    "the budget of add_remove under replace": (
        TwiceTheBudget, (staying(1), staying(3)), {}, 1.38
    ),
    "charged for the count alone": (
        ChargedForTheCountAlone, (staying(1), staying(3)), {}, 1.38
    ),
    "a ratio of two": (
        RatioOfTwo, (staying(1), staying(1, ROAD.speed_limit)), {"pace": 0.4}, 1.13
    ),
    # A vehicle spends 95 % of its budget in an episode: 1.41 times the root of that.
    "noise divided by 1.41": (Paced, (staying(1), staying(3)), {}, 1.36),
}  # fmt: skip


def attacked(case, record, n_runs):
    kind, pair, wish, least = case
    # Vehicles can deviate oppositely from half the limit.
    estimator = HalfTheLimit if kind is RatioOfTwo else "open_loop"
    setting = paced(estimator, preset=kind, **wish)
    worlds = AdjacentWorlds(record, pair)
    factor = 1.0 / 1.41 if kind is Paced else 1.0
    policy = make_policy(setting, "hunter", worlds)
    runs = attack(setting, worlds, policy, n_runs, noise_factor=factor, progress=False)
    assert runs.distances.min() > least * CLAIM.mu
    return audit(*runs.scores, CLAIM)


@pytest.mark.parametrize("case", BLATANT.values(), ids=BLATANT)
def test_blatant_faults_are_rejected_after_some_hundred_runs(case, record):
    assert attacked(case, record, 250).verdict == "rejected"


@pytest.mark.slow
@pytest.mark.parametrize("case", SUBTLE.values(), ids=SUBTLE)
def test_faults_are_rejected_after_five_thousand_runs(case, record):
    assert attacked(case, record, 5000).verdict == "rejected"


@pytest.mark.slow
@pytest.mark.parametrize("n_runs", [250, 5000])
def test_correct_ledgers_are_not_rejected(n_runs, record):
    kind = keeping(PlainLedgers) if n_runs == 250 else keeping(Ledgers)
    case = kind, (staying(1), staying(3)), {}, 0.97
    assert attacked(case, record, n_runs).verdict == "not rejected"
