from itertools import combinations

import numpy as np

from agents import seeds
from agents.seeds import TRAINING, TRAININGS, training_seed
from dptse_env.config import TEST_SEEDS

NOISE_SEEDS = {name: value for name, value in vars(seeds).items() if isinstance(value, range)}


def test_no_two_uses_share_a_seed():
    assert len(NOISE_SEEDS) == 8
    for (first, a), (second, b) in combinations(NOISE_SEEDS.items(), 2):
        assert a.stop <= b.start or b.stop <= a.start, (first, second)


def test_every_range_holds_every_traffic_seed():
    assert min(map(len, NOISE_SEEDS.values())) >= TEST_SEEDS.stop


def test_trainings_have_stretches_of_their_own():
    first = np.array([training_seed(seed) for seed in range(TRAININGS)])
    assert first[0] == TRAINING.start
    assert (np.diff(first) >= 1_000_000).all()
    assert first[-1] + 1_000_000 <= TRAINING.stop
