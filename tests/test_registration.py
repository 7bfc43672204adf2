"""Ids: each can be made without a warning, and those of the pages are there."""

import re
import warnings

import gymnasium as gym
import pytest

from dptse_env.registration import ENVIRONMENTS
from tests.helpers import ROOT

PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.py")]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_an_id_gives_no_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gym.make(f"dptse_env:{name}").close()
        gym.make_vec(f"dptse_env:{name}", num_envs=2).close()


def test_the_pages_name_ids_that_there_are():
    named = {
        name
        for page in PAGES
        if page.name != "CHANGELOG.md"
        for name in re.findall(r"\bdptse/\w+-v\d+", page.read_text(encoding="utf-8"))
    }
    assert "dptse/PaperHighway-v0" in named
    assert named <= {*ENVIRONMENTS}
