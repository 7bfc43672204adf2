"""The fuzzer sees what escapes, and draws the same cases from the same seed."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from dptse_env.config import resolve
from tests import fuzz


def refuse(message):
    def use():
        raise ValueError(message)

    return use


def forget_a_key():
    return {}["key"]


def test_what_is_not_one_short_line_with_a_path_has_escaped():
    road = Path("/folder/road.toml")
    for use, place, expected in (
        (lambda: None, road, "worked"),
        (refuse("bandwidth must be 1, got 2"), ("bandwidth",), "refused: bandwidth must"),
        (refuse(f"{road}: it must be"), road, f"refused: {road}"),
        (refuse("must be, got 2"), ("bandwidth",), "escaped: no path"),
        (refuse("it must be"), road, "escaped: no path"),
        (refuse("bandwidth\nmust be"), ("bandwidth",), "escaped: 2 lines"),
        (refuse(f"{road} must be {'x' * 9999}"), road, "escaped: 100"),
        (forget_a_key, road, "escaped: KeyError: 'key' "),
    ):
        assert fuzz.verdict(use, place).startswith(expected)


@pytest.mark.parametrize("limit", ["LONGEST", "MEMORY"])
def test_time_and_memory_are_limited(limit, monkeypatch):
    monkeypatch.setattr(fuzz, limit, -1)
    assert fuzz.verdict(lambda: None, Path()).startswith("escaped: it took")


def test_a_case_is_drawn_again_from_its_seed_and_number(tmp_path):
    for kind in ("configurations", "fields", "weights"):
        drawn = []
        for seed in (0, 0, 1):
            rng = np.random.default_rng([seed, 5])
            drawn.append(repr(fuzz.KINDS[kind](rng, tmp_path)[0]))
        assert drawn[0] == drawn[1] != drawn[2]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_some_corridors_that_are_drawn_are_in_order():
    rng, n_made = np.random.default_rng(0), 0
    for _ in range(30):
        drawn = fuzz.keyword("corridor", rng, {})
        if isinstance(drawn, dict) and drawn:
            with contextlib.suppress(ValueError):
                n_made += resolve("paper-highway", {"corridor": drawn}).corridor.name != ""
    assert n_made > 0


@pytest.mark.slow
def test_nothing_escapes(capfd):
    status = fuzz.main(["--configurations", "40", "--files", "40"])
    said = capfd.readouterr().out
    assert status == 0, said
    assert said.split("configurations")[1].split()[0] == "40"
