"""No two uses of noise share a seed."""

from itertools import combinations

import numpy as np

from agents import seeds
from agents.seeds import TRAINING, TRAININGS, seed_kind, training_seed
from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS

TRAFFIC = TRAINING_SEEDS, VALIDATION_SEEDS, TEST_SEEDS
NOISE = [x for x in vars(seeds).values() if isinstance(x, range) and x not in TRAFFIC]


def test_ranges_are_apart_and_hold_every_traffic_seed():
    assert all(a.stop <= b.start or b.stop <= a.start for a, b in combinations(NOISE, 2))
    assert min(map(len, NOISE)) >= TEST_SEEDS.stop


def test_trainings_have_stretches_of_their_own():
    first = np.array([training_seed(seed) for seed in range(TRAININGS)])
    assert first[0] == TRAINING.start
    assert (np.diff(first) >= 1_000_000).all()
    assert first[-1] + 1_000_000 <= TRAINING.stop


def test_seeds_are_named_by_their_range():
    kinds = [seed_kind(x) for x in (range(500, 502), (1000, 1999), (2000, 2999), (999, 1000))]
    assert kinds == ["training", "validation", "test", "mixed"]
