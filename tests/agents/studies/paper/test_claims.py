import pytest

from agents.experiments.cells import UnmeasuredError
from agents.statistics import Interval
from agents.studies.paper.claims import BELOW_ZERO, Claim, ExpectedRange, combine, judge, judge_part
from agents.studies.paper.plan import SETTINGS


def interval(low, high):
    return Interval((low + high) / 2.0, low, high, 10)


@pytest.mark.parametrize(
    ("expected", "held", "failed", "open_"),
    [
        (ExpectedRange(high=0.0), (-2.0, -1.0), (1.0, 2.0), (-1.0, 1.0)),
        (ExpectedRange(low=0.0), (1.0, 2.0), (-2.0, -1.0), (-1.0, 1.0)),
        (ExpectedRange(-5.0, 5.0), (-4.0, 4.0), (5.5, 9.0), (4.0, 6.0)),
        (ExpectedRange(-5.0, 5.0), (1.0, 2.0), (-9.0, -5.5), (-6.0, 6.0)),
        (ExpectedRange(low=0.9), (0.95, 0.99), (0.1, 0.5), (0.8, 0.95)),
        (ExpectedRange(high=0.0), (-2.0, -1.0), (1.0, 2.0), (-1.0, 0.0)),
        (ExpectedRange(high=0.0), (-2.0, -1.0), (1.0, 2.0), (0.0, 0.0)),
        (ExpectedRange(low=0.0), (1.0, 2.0), (-2.0, -1.0), (0.0, 1.0)),
    ],
)
def test_a_part_is_judged_by_its_whole_interval(expected, held, failed, open_):
    assert judge_part(interval(*held), expected) == "holds"
    assert judge_part(interval(*failed), expected) == "does not hold"
    assert judge_part(interval(*open_), expected) == "undecided"


@pytest.mark.parametrize(
    ("parts", "verdict"),
    [
        (["holds", "holds"], "holds"),
        (["holds", "undecided"], "undecided"),
        (["undecided", "does not hold"], "does not hold"),
        (["holds", "does not hold"], "does not hold"),
    ],
)
def test_a_claim_holds_if_all_parts_do_and_fails_if_one_fails(parts, verdict):
    assert combine(parts) == verdict


def test_no_part_is_no_verdict():
    with pytest.raises(ValueError, match="at least one part"):
        combine([])


def test_what_was_not_run_is_not_judged():
    def measure(results, setting):
        raise UnmeasuredError

    claim = Claim("X", "statement", "quantity", "1", BELOW_ZERO, measure)
    outcome = judge(claim, None, SETTINGS[0])
    assert outcome.verdict == "not measured"
    assert outcome.parts == {}


def test_an_outcome_keeps_its_parts():
    parts = {"a": interval(-2.0, -1.0), "b": interval(-1.0, 1.0)}
    claim = Claim("X", "statement", "quantity", "1", BELOW_ZERO, lambda results, setting: parts)
    outcome = judge(claim, None, SETTINGS[0])
    assert {name: verdict for name, (_, verdict) in outcome.parts.items()} == {
        "a": "holds",
        "b": "undecided",
    }
    assert outcome.verdict == "undecided"


def test_a_range_says_itself():
    texts = map(str, (BELOW_ZERO, ExpectedRange(low=0.9), ExpectedRange(-5.0, 5.0)))
    assert list(texts) == ["below 0", "above 0.9", "between -5 and 5"]
