"""Seeds of noise and estimators: one table of disjoint ranges, by what draws from them.

An episode's generator is seeded with the first number of a range plus its traffic seed, or, in a
training, plus the number of the episode. Choices and reports never share a range.
"""

from __future__ import annotations

from collections.abc import Sequence

from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS

EVALUATION = range(1_000_000)
"""``dptse evaluate``, and the studies of estimators, of privacy and of ledgers."""
TUNING = range(1_000_000, 2_000_000)
"""The search of estimator settings."""
CHOICE = range(2_000_000, 3_000_000)
"""The choice of parameters, estimator and query rule for a road, and of the rule of a task of the
query suite, on validation traffic."""
TRAINING_VALIDATION = range(4_000_000, 5_000_000)
"""The learning curve of a training, by which its best policy is kept, and the rules beside it."""
SUITE = range(7_000_000, 8_000_000)
"""The tasks of the query suite."""
TRAINING = range(10_000_000, 1_010_000_000)
"""Training episodes; see `training_seed`."""

TRAININGS = 1_000
"""Training seeds are in 0..999; each has its separate stretch of `TRAINING`."""


def training_seed(seed: int) -> int:
    """Return the seed of the first episode of a training, a million apart from the next one's."""
    return TRAINING.start + seed * (len(TRAINING) // TRAININGS)


def require_seeds(path: str, seeds: Sequence[int], allowed: range) -> None:
    """Refuse traffic seeds out of a range, and none at all.

    Raises:
        ValueError: A seed is outside, or there is none.
    """
    outside = [seed for seed in seeds if seed not in allowed]
    if outside or not seeds:
        raise ValueError(
            f"{path} must be traffic seeds in {allowed[0]}..{allowed[-1]}, got "
            f"{outside[0] if outside else 'none'}"
        )


KINDS = {"training": TRAINING_SEEDS, "validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
"""Kinds of traffic, and the seeds that each may have."""


def seed_kind(seeds: Sequence[int]) -> str:
    """Return which range traffic seeds belong to: training, validation, test, or mixed."""
    kinds = [name for name, members in KINDS.items() if set(seeds) <= set(members)]
    return kinds[0] if kinds else "mixed"
