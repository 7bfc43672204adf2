from itertools import combinations

import numpy as np
import pytest

from agents import seeds
from agents.seeds import TRAINING, TRAININGS, seed_kind, training_seed
from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS

NOISE_SEEDS = {
    name: value
    for name, value in vars(seeds).items()
    if isinstance(value, range) and value not in (TRAINING_SEEDS, VALIDATION_SEEDS, TEST_SEEDS)
}


def test_no_two_uses_share_a_seed():
    for (first, a), (second, b) in combinations(NOISE_SEEDS.items(), 2):
        assert a.stop <= b.start or b.stop <= a.start, (first, second)


def test_every_range_holds_every_traffic_seed():
    assert min(map(len, NOISE_SEEDS.values())) >= TEST_SEEDS.stop


def test_trainings_have_stretches_of_their_own():
    first = np.array([training_seed(seed) for seed in range(TRAININGS)])
    assert first[0] == TRAINING.start
    assert (np.diff(first) >= 1_000_000).all()
    assert first[-1] + 1_000_000 <= TRAINING.stop


@pytest.mark.parametrize(
    ("numbers", "kind"),
    [
        (range(500, 502), "training"),
        ((1000, 1999), "validation"),
        ((2000, 2999), "test"),
        ((999, 1000), "mixed"),
        ((2999, 3000), "mixed"),
    ],
)
def test_seeds_are_named_by_their_range(numbers, kind):
    assert seed_kind(numbers) == kind
