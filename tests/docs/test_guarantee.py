"""The guarantee states numbers that are so, and the proof names code and tests that exist."""

import importlib
import re
from operator import attrgetter

import pytest
from scipy.special import ndtr

from dptse_env.privacy import DELTAS, epsilon_of, mu_of, over_trips, rounded_up
from tests.helpers import ROOT

GUARANTEE, PROOF = (
    (ROOT / "docs" / "privacy" / name).read_text(encoding="utf-8")
    for name in ("guarantee.md", "proof.md")
)
# Less by what rounding could add: what is 5.0 exactly is not to become 5.1.
MUS = [(1.0 - 1e-12) * mu_of(*pair) for pair in ((1.0, 0.05), (5.0, 1e-6), (5.0, 0.05))]
TITLE = re.compile(r"^### (\d+)\. ", re.MULTILINE)


def test_the_guarantee_has_the_epsilons_of_its_mus():
    guesses = " | ".join(f"{rounded_up(100.0 * ndtr(mu / 2.0), '.0f')} %" for mu in MUS)
    assert f"| best guess is right | {guesses} |\n" in GUARANTEE
    for delta in DELTAS:
        epsilons = " | ".join(rounded_up(epsilon_of(mu, float(delta)), ".1f") for mu in MUS)
        assert f"| ε at δ = {delta} | {epsilons} |\n" in GUARANTEE
    accounts = [over_trips(mu) for mu in MUS[1:]]
    for n, of_n in zip(accounts[0], zip(*map(dict.values, accounts), strict=True), strict=True):
        pairs = [(rounded_up(r["mu"], ".2f"), rounded_up(r["1e-5"], ".1f")) for r in of_n]
        row = " | ".join(" | ".join(pair) for pair in pairs)
        assert re.search(rf"^\| {n} \| [\w ]*\| {re.escape(row)} \|$", GUARANTEE, re.MULTILINE)


@pytest.mark.parametrize("line", TITLE.split(PROOF)[2::2], ids=TITLE.findall(PROOF))
def test_a_line_of_the_proof_names_code_and_tests_that_exist(line):
    (code,), (tests,) = (
        re.findall(rf"^- {kind}: (.*?)$\n(?! )", line, re.MULTILINE | re.DOTALL)
        for kind in ("Code", "Test")
    )
    for path, names in named(code):
        module = importlib.import_module(path.removesuffix(".py").replace("/", "."))
        for name in names:
            attrgetter(name)(module)
    for path, names in named(tests):
        text = (ROOT / path).read_text(encoding="utf-8")
        assert all(f"\ndef {name}(" in text for name in names)


def named(text):
    """Return pairs of a file and what is named after it; there is one pair at least."""
    pairs = re.findall(r"`([\w/]+\.py)`:\s+((?:`[\w.]+`,?\s*)+)", text)
    assert pairs
    return [(path, re.findall(r"`([\w.]+)`", names)) for path, names in pairs]


def test_lines_of_the_proof_are_numbered():
    numbers = [int(number) for number in TITLE.findall(PROOF)]
    assert numbers == list(range(1, len(numbers) + 1))
