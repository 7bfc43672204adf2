import dataclasses
import json

import pytest

from agents.suite.card import DONE, FAILED, Card, CellResult

from .small import SMALL

CELL = SMALL.cells[0]
RESULT = CellResult(
    CELL.name, CELL.digest, DONE, traffic_seeds=(2000, 2001, 2002), error=(50.0, 60.0, 70.0),
    density=(10.0, 11.0, 12.0), speed=(5.0, 6.0, 7.0), chi2_density=1.0, chi2_speed=1.5,
    epsilon=None, delta=0.05, queries_a_second=2.0, policy_ms=0.1, step_ms=1.0,
)  # fmt: skip
BAD = CellResult("wide", SMALL.cells[1].digest, FAILED, "raised KeyError: 3")
CARD = Card("small-v1", "mine", "a:B", "a:B 12", {"numpy": "2"}, {"plain": RESULT, "wide": BAD})


def test_a_card_is_read_as_it_was_written(tmp_path):
    CARD.write(tmp_path / "mine.json")
    assert Card.read(tmp_path / "mine.json") == CARD
    CARD.check(SMALL, "mine.json")


def edited(path, change):
    """Write the card with a change of its plain content."""
    CARD.write(path)
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["results"]["plain"]["error"].__setitem__(0, 1.0), "changed after it was"),
        (lambda c: c["results"]["plain"].pop("speed"), "is no card of a suite: a result must have"),
        (lambda c: c["results"]["plain"].update(error=[float("nan")] * 3), "is no card"),
        (lambda c: c["results"]["plain"].update(error=["a"] * 3), "is no card"),
        (lambda c: c["results"]["plain"].update(error=[1.0]), "must have 3 errors of each kind"),
        (lambda c: c["results"]["plain"].update(error=5.0), "is no card"),
        (lambda c: c["results"]["plain"].update(status="won"), "status of cell 'plain'"),
        (lambda c: c["results"]["wide"].update(status="done"), "does not agree with its numbers"),
        (lambda c: c.update(results=[]), "is no card"),
        (lambda c: c.update(name=5), "must be strings"),
        (lambda c: c.update(more=5), "is no card"),
        (lambda c: c.pop("digest"), "is no card"),
    ],
)
def test_a_damaged_card_is_refused(change, message, tmp_path):
    path = edited(tmp_path / "mine.json", change)
    with pytest.raises(ValueError, match=message):
        Card.read(path)


def test_what_is_no_json_object_is_no_card(tmp_path):
    path = tmp_path / "mine.json"
    for text in ("", "[]", "{", "\x00"):
        path.write_text(text)
        with pytest.raises(ValueError, match="is no card of a suite"):
            Card.read(path)
    with pytest.raises(FileNotFoundError):
        Card.read(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"digest": "0" * 16}, "'plain' has digest 0000000000000000, here it has"),
        ({"traffic_seeds": (2000, 2001, 2003)}, "was run on other seeds than 2000:2003"),
        ({"cell": "wide"}, "'plain' has digest"),
    ],
)
def test_a_card_of_another_version_is_refused_by_name(changes, message):
    card = dataclasses.replace(CARD, results={"plain": dataclasses.replace(RESULT, **changes)})
    with pytest.raises(ValueError, match=message):
        card.check(SMALL, "mine.json")


def test_a_card_of_another_suite_is_refused_by_name():
    with pytest.raises(ValueError, match="is a card of 'other-v1', not of 'small-v1'"):
        dataclasses.replace(CARD, suite="other-v1").check(SMALL, "mine.json")
    card = dataclasses.replace(CARD, results={"moon": RESULT})
    with pytest.raises(ValueError, match="cell must be one of plain, wide, paced, got 'moon'"):
        card.check(SMALL, "mine.json")


def test_a_digest_depends_on_what_errors_depend_on():
    digests = {cell.digest for cell in SMALL.cells}
    for changes in (
        {"seeds": "2000:2004"},
        {"keywords": {**CELL.keywords, "epsilon": 2.0}},
        {"keywords": {**CELL.keywords, "estimator": "random_walk"}},
        {"keywords": {**CELL.keywords, "corridor": {"fixed_sensors": [3]}}},
        {"keywords": {**CELL.keywords, "parameters": "w99-3lane"}},
    ):
        digests.add(dataclasses.replace(CELL, **changes).digest)
    assert len(digests) == 8
    assert dataclasses.replace(CELL, description="another text").digest == CELL.digest
