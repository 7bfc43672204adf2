"""Intervals on the pages of results: each is one of the tables that a program wrote."""

import re
from itertools import product

import pytest

from agents.studies import roads
from agents.study import read_rows
from agents.tables import ERROR, mean
from tests.helpers import ROOT

RESULTS = ROOT / "results"
STUDIES = [
    path.parent.name
    for path in sorted(RESULTS.glob("*/tables.md"))
    if path.with_name("README.md").is_file()
]
NUMBER = r"[-−]?\d[\d,]*(?:\.\d+)?"
INTERVAL = re.compile(rf"({NUMBER}) (?:\[({NUMBER}), ({NUMBER})\]|± (\d[\d.]*\d|\d))")

pytestmark = pytest.mark.skipif(not RESULTS.is_dir(), reason="a source archive has no results")


def value(text):
    return float(text.replace("−", "-").replace(",", ""))


def decimals(text):
    return len(text.partition(".")[2])


def intervals(text):
    """Mean and ends of each interval of a text, as it is written, and with how many decimals."""
    for found in INTERVAL.finditer(text):
        mean, low, high, half = found.groups()
        if half is not None:
            low, high = (str(value(mean) + sign * value(half)) for sign in (-1, 1))
        yield found[0], [value(each) for each in (mean, low, high)], decimals(found[1])


def sections(text):
    """The parts of a page but for those that name a command for their figures."""
    parts = re.split(r"^## ", text, flags=re.MULTILINE)
    return "\n".join(part for part in parts if "dptse evaluate --env" not in part)


def is_among(interval, places, table):
    """Return whether a table has an interval to within rounding, with either sign."""
    room = 0.51 * 10.0**-places + 1e-9
    mean, low, high = interval
    turned = [-mean, -high, -low]
    return any(
        all(
            abs(a - b) <= room * (1 if k == 0 else 2)
            for k, (a, b) in enumerate(zip(x, y, strict=True))
        )
        for x in table
        for y in ((mean, low, high), turned)
    )


def by_another_simulator():
    """Errors on a road that no table has, since its simulator is not here."""
    rows = read_rows("roads", RESULTS / "roads")
    cells = product((roads.PACED, roads.CORRECTED), ("ekf", "blend", "asm", "recurrent"))
    return [mean(rows, roads.on_road("another simulator", *each), ERROR) for each in cells]


@pytest.mark.parametrize(
    "page", ["README.md", "docs/results.md", *map("results/{}/README.md".format, STUDIES)]
)
def test_intervals_are_those_of_a_table(page):
    own = [name for name in STUDIES if f"/{name}/" in page] or STUDIES
    tables = "\n".join((RESULTS / name / "tables.md").read_text("utf-8") for name in own)
    known = [numbers for _, numbers, _ in intervals(tables)]
    if "roads" in own:
        known += [[found.mean, found.low, found.high] for found in by_another_simulator()]
    said = list(intervals(sections((ROOT / page).read_text("utf-8"))))
    assert [text for text, numbers, places in said if not is_among(numbers, places, known)] == []
