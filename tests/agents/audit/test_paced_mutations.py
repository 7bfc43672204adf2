"""Wrong ledgers and too little noise, as the audit sees them.

The deterministic distances of ``tests/release/test_paced.py`` catch each of them surely;
here an adversary has to find it in noisy transcripts of the decision process.
"""

import numpy as np
import pytest

from agents.audit.statistics import Claim, audit
from agents.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.privacy import mu_of
from dptse_env.release import Paced
from dptse_env.release.vehicles import Ledgers

from .small import HORIZON, N_COLUMNS, ROAD, SECONDS, HalfTheLimit, paced, runs_of, staying

CLAIM = Claim(mu_of(5.0, 0.05), 5.0, 0.05)


class LedgerForEachSegment(Ledgers):
    def reset(self, episodes, n_vehicles=None):
        super().reset(episodes, None if n_vehicles is None else n_vehicles * N_COLUMNS)

    def collect(self, episodes, observed, rows, *public):
        accounts = (rows.vehicle * N_COLUMNS + rows.place).astype(np.int32)
        return super().collect(episodes, observed, rows._replace(vehicle=accounts), *public)


class ReleasedUnclipped(Ledgers):
    """Releases what it charges for as if it were clipped."""

    def collect(self, episodes, observed, rows, prices, centre, sigma):
        sums, refused = super().collect(episodes, observed, rows, prices, centre, sigma)
        # All vehicles on the audited segments stand: each deviates by the centre.
        sums[..., 1] = -sums[..., 0] * centre[:, : observed.shape[1]]
        return sums, refused


class FreeSensors(Ledgers):
    def collect(self, episodes, observed, *public):
        free = observed & np.isin(np.arange(observed.shape[1]), ROAD.fixed_sensors)
        budget, paid = self.budget, self.paid[episodes].copy()
        self.budget = np.full_like(budget, np.inf)
        unpaid = super().collect(episodes, free, *public)
        self.budget, self.paid[episodes] = budget, paid
        charged = super().collect(episodes, observed & ~free, *public)
        return tuple(one + other for one, other in zip(charged, unpaid, strict=True))


def keeping(kind):
    """The paced release with other ledgers."""

    class Mutant(Paced):
        def __init__(self, task, traffic):
            super().__init__(task, traffic)
            own = self.ledgers
            self.ledgers = kind(
                task.columns, task.n_episodes, own.budget,
                ratio=own.ratio, clip=own.clip, fastest=own.fastest,
            )  # fmt: skip

    return Mutant


class TwiceTheBudget(Paced):
    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.ledgers.budget *= 2.0


class ChargedForTheCountAlone(Paced):
    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.ledgers.ratio = 0.0


class RatioOfTwo(Paced):
    def __init__(self, task, traffic):
        object.__setattr__(task.settings, "ratio", 2.0)
        super().__init__(task, traffic)


def roving(offset):
    return Trajectory(SECONDS, (SECONDS + offset) % 5, np.zeros(HORIZON))


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
    kind, pair, privacy, least = case
    # Vehicles can deviate oppositely from half the limit.
    estimator = HalfTheLimit if kind is RatioOfTwo else "open_loop"
    setting = paced(estimator, preset=kind, **privacy)
    worlds = AdjacentWorlds(record, pair)
    factor = 1.0 / 1.41 if kind is Paced else 1.0
    runs = runs_of(setting, worlds, n_runs, noise_factor=factor)
    assert runs.distances.min() > least * CLAIM.mu
    return audit(*runs.scores, CLAIM)


@pytest.mark.parametrize("case", BLATANT.values(), ids=BLATANT)
def test_blatant_faults_are_rejected_after_some_hundred_runs(case, record):
    assert attacked(case, record, 150).verdict == "rejected"


@pytest.mark.slow
@pytest.mark.parametrize("case", SUBTLE.values(), ids=SUBTLE)
def test_faults_are_rejected_after_five_thousand_runs(case, record):
    assert attacked(case, record, 5000).verdict == "rejected"


@pytest.mark.slow
def test_correct_ledgers_are_not_rejected(record):
    case = keeping(Ledgers), (staying(1), staying(3)), {}, 0.97
    assert attacked(case, record, 5000).verdict == "not rejected"
