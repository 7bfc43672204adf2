"""Verification of a card: a drawn cell is run again and its errors are compared."""

from __future__ import annotations

import random
from typing import NamedTuple

import numpy as np

from agents.policies import PolicySource
from agents.suite.card import DONE, Card
from agents.suite.cells import Suite
from agents.suite.running import SuiteTask, run_cell
from dptse_env.traffic import Records

TOLERANCE = 1e-6
"""Largest relative difference of an error that counts as the same."""


class Verification(NamedTuple):
    """Result of running a cell of a card again.

    Attributes:
        cell: The cell that was drawn.
        largest: Largest relative difference of an episode's error.
        means: Mean error on the card, and now.
        is_same: Whether all errors agree within `TOLERANCE`.
    """

    cell: str
    largest: float
    means: tuple[float, float]
    is_same: bool


def verify(
    card: Card, suite: Suite, policy: PolicySource, records: Records, draw: int | None = None
) -> Verification:
    """Run a drawn cell of a card again and compare errors, densities and speeds by traffic seed.

    Args:
        card: The card, checked against the suite.
        suite: The suite.
        policy: The policy that the card is of.
        records: Library of records, or its folder; None for the user's cache.
        draw: Seeds the draw; at random if None, so that a card cannot be made for one cell.

    Raises:
        ValueError: The policy is not the one of the card, no cell is done, or the policy fails now
            in the drawn cell.
    """
    if policy.identity != card.identity:
        raise ValueError(
            f"{policy.source!r} is not the policy of the card, {card.source!r}: digests differ"
        )
    done = [name for name, result in card.results.items() if result.status == DONE]
    if not done:
        raise ValueError(f"the card of {card.name!r} has no cell that is done")
    name = random.Random(draw).choice(done)
    before, now = card.results[name], run_cell(SuiteTask(policy, suite.cell(name), records))
    if now.status != DONE:
        raise ValueError(f"{card.source!r} fails in cell {name!r} now: {now.reason}")
    pairs = [
        (np.array(getattr(before, kind)), np.array(getattr(now, kind)))
        for kind in ("error", "density", "speed")
    ]
    largest = max(float(np.abs(new / old - 1.0).max()) for old, new in pairs)
    means = float(np.mean(before.error)), float(np.mean(now.error))
    return Verification(name, largest, means, largest <= TOLERANCE)
