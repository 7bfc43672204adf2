"""The page of the suite against the cards that ship."""

import random
from pathlib import Path

import pytest

from agents.policies import find_policy
from agents.suite.cells import ONE, SUITES, ZERO, find_suite
from agents.suite.table import score_table, shipped_cards, suite_table
from agents.suite.verifying import verify

PAGE = Path(__file__).parents[1] / "docs" / "suite.md"


def part(name):
    return PAGE.read_text().split(f"<!-- {name} -->\n")[1].split("<!-- end -->")[0].strip()


def test_the_tables_of_the_page_are_those_of_the_cards():
    suite = find_suite("query-suite-v2")
    cards = shipped_cards(suite)
    zero, one = cards[ZERO], cards[ONE]
    assert part("scores") == score_table(list(cards.values()), zero, one, suite).strip()
    assert part("cells") == suite_table(suite, zero, one).strip()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SUITES))
def test_a_drawn_cell_of_three_drawn_cards_is_right(name):
    suite = find_suite(name)
    for card in random.sample(list(shipped_cards(suite).values()), 3):
        assert verify(card, suite, find_policy(card.source), None).is_same
