"""The guarantee states numbers that are so, and the proof names code and tests that exist."""

import importlib
import re
from operator import attrgetter

import pytest
from scipy.special import ndtr

from dptse_env.privacy import DELTAS, epsilon_of, mu_of, over_trips

from .blocks import ROOT

GUARANTEE, PROOF = (
    (ROOT / "docs" / "privacy" / name).read_text(encoding="utf-8")
    for name in ("guarantee.md", "proof.md")
)
MUS = [mu_of(*pair) for pair in ((1.0, 0.05), (5.0, 1e-6), (5.0, 0.05))]
TITLE = re.compile(r"^### (\d+)\. ", re.MULTILINE)


def test_the_guarantee_has_the_epsilons_of_its_mus():
    guesses = " | ".join(f"{100.0 * ndtr(mu / 2.0):.0f} %" for mu in MUS)
    assert f"| best guess is right | {guesses} |\n" in GUARANTEE
    for delta in DELTAS:
        epsilons = " | ".join(f"{epsilon_of(mu, float(delta)):.1f}" for mu in MUS)
        assert f"| ε at δ = {delta} | {epsilons} |\n" in GUARANTEE
    accounts = [over_trips(mu) for mu in MUS[1:]]
    for n in accounts[0]:
        row = " | ".join(f"{each[n]['mu']:.2f} | {each[n]['1e-5']:.1f}" for each in accounts)
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
