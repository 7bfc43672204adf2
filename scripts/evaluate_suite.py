"""The part of ``scripts/evaluate.py`` that scores policies in the cells of a suite."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from agents.policies import find_policy
from agents.suite.card import FAILED, Card
from agents.suite.cells import ONE, ZERO, Suite, find_suite
from agents.suite.suite import run_suite
from agents.suite.table import score_table, shipped_cards
from agents.suite.verifying import verify
from dptse_env.traffic import Records
from scripts.cli import Machines, records_argument


def evaluate_suite(
    name: str,
    policies: Sequence[str],
    card: Path | None,
    folder: Path,
    options: Machines,
    as_json: bool = False,
) -> None:
    """Score policies in a suite and leave their cards in a folder, or verify a card.

    Raises:
        FileNotFoundError: There is no such policy or card.
        ValueError: An argument or a card is bad.
        SystemExit: A verified card does not agree, with status 1.
    """
    suite = find_suite(name)
    if card is not None:
        _verify(suite, card, policies, records_argument(options.records), as_json)
        return
    if not policies:
        raise ValueError(f"policies must be one or more, to be scored in {suite.name}")
    cards = run_suite(suite, policies, options.workplace(folder))
    if as_json:
        print(json.dumps([each.content for each in cards], indent=2))
        return
    _print(suite, cards, {**{each.name: each for each in cards}, **shipped_cards(suite)})
    print(f"cards are in {folder}/")


def _print(suite: Suite, cards: Sequence[Card], known: Mapping[str, Card]) -> None:
    for each in cards:
        for result in each.results.values():
            if result.status == FAILED:
                print(f"{each.name} failed in {result.cell}: {result.reason}")
    references = [known[name] for name in (ZERO, ONE) if name in known]
    if len(references) == 2:
        print(score_table(cards, references[0], references[1], suite))


def _verify(
    suite: Suite, path: Path, policies: Sequence[str], records: Records, as_json: bool
) -> None:
    card = Card.read(path)
    card.check(suite, path)
    if len(policies) > 1:
        raise ValueError("policies must be one, that of the card, or none where its source is here")
    found = verify(card, suite, find_policy(policies[0] if policies else card.source), records)
    said, now = found.means
    if as_json:
        print(json.dumps(found._asdict(), indent=2))
    elif found.is_same:
        print(f"cell {found.cell}: errors agree, mean error x 1000 {now:.3f}")
    if not found.is_same:
        print(
            f"error: {path}: in cell {found.cell!r} the mean error x 1000 is {said:.3f} on the "
            f"card and {now:.3f} now, episodes differ by up to {100.0 * found.largest:.2g} %",
            file=sys.stderr,
        )
        raise SystemExit(1)
