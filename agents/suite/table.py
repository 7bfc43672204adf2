"""Tables of cards, in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agents.experiments.old_tables import markdown
from agents.statistics import Interval
from agents.suite.card import DONE, Card, CellResult
from agents.suite.cells import Suite
from agents.suite.scoring import scores, suite_score

CARDS = Path(__file__).parent / "cards"
"""Folder with a folder of cards for each suite: those of the policies that ship."""


def shipped_cards(suite: Suite) -> dict[str, Card]:
    """Return the cards that ship, by the names of their policies.

    Raises:
        ValueError: A card is damaged or of another version.
    """
    cards = {}
    for path in sorted((CARDS / suite.name).glob("*.json")):
        card = Card.read(path)
        card.check(suite, path)
        cards[card.name] = card
    return cards


def score_table(cards: Sequence[Card], zero: Card, one: Card, suite: Suite) -> str:
    """Return the normalised scores of policies by cell, the best mean first.

    Args:
        cards: Cards of the policies.
        zero: Card of the schedule that has 0.
        one: Card of the oracle that has 1.
        suite: The suite.
    """
    by_card = [(card, scores(card, zero, one, suite)) for card in cards]
    rows = []
    for card, found in sorted(by_card, key=lambda pair: _order(pair[1], suite)):
        total = suite_score(found, suite)
        cells = [
            f"{found[cell.name].mean:.2f} ± {found[cell.name].half_width:.2f}"
            if cell.name in found
            else _absent(card, cell.name)
            for cell in suite.cells
        ]
        rows.append([f"`{card.name}`", "-" if total is None else f"{total:.2f}", *cells])
    return markdown(["policy", "mean", *(f"`{cell.name}`" for cell in suite.cells)], rows)


def _order(found: dict[str, Interval], suite: Suite) -> tuple[float, ...]:
    total = suite_score(found, suite)
    return (1.0, 0.0) if total is None else (0.0, -total)


def _absent(card: Card, cell: str) -> str:
    return "failed" if cell in card.results else "-"


def cell_table(cards: Sequence[Card], cell: str) -> str:
    """Return errors, honesty, privacy and time of policies in a cell, the least error first."""
    results = [(card, card.results[cell]) for card in cards if cell in card.results]
    results.sort(key=lambda pair: np.mean(pair[1].error) if pair[1].error else np.inf)
    rows = [[f"`{card.name}`", *_numbers(result)] for card, result in results]
    header = [
        "policy", "error x 1000", "density [veh/km]", "speed [km/h]", "χ²", "refused [%]",
        "queries a second", "decision [ms]",
    ]  # fmt: skip
    return markdown(header, rows)


def _numbers(result: CellResult) -> list[str]:
    if result.status != DONE:
        return [result.reason, *["-"] * 6]
    refused = result.percent_refused
    return [
        *(f"{np.mean(values):.{digits}f}" for values, digits in (
            (result.error, 1), (result.density, 2), (result.speed, 2)
        )),
        f"{result.chi2_density:.2f}, {result.chi2_speed:.2f}",
        "-" if refused is None else f"{refused:.1f}",
        f"{result.queries_a_second:.1f}",
        f"{result.policy_ms:.3f}",
    ]  # fmt: skip


def suite_table(suite: Suite, zero: Card, one: Card) -> str:
    """Return the cells with their traffic and the errors x 1000 of both references."""
    rows = [
        [
            f"`{cell.name}`", cell.description, cell.seeds,
            *(f"{np.mean(card.results[cell.name].error):.1f}" for card in (zero, one)),
        ]
        for cell in suite.cells
    ]  # fmt: skip
    header = ["cell", "what it is", "traffic seeds", f"`{zero.name}`: 0", f"`{one.name}`: 1"]
    return markdown(header, rows)
