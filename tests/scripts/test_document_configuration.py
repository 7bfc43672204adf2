"""The page of keywords is what the code says."""

import dataclasses

from dptse_env.config import EnvConfig
from dptse_env.traffic import Corridor
from scripts.document_configuration import PAGE, describe_type, read_meanings, render


def test_the_page_is_that_of_the_code():
    assert PAGE.read_text(encoding="utf-8") == render(), (
        "docs/configuration.md is out of date: run python scripts/document_configuration.py"
    )


def test_every_field_has_a_meaning():
    for cls in (EnvConfig, Corridor):
        names = {field.name for field in dataclasses.fields(cls)}
        assert names == set(read_meanings(cls, "Attributes"))


def test_types_and_ranges_are_in_words():
    assert describe_type(int | None) == "an integer or `None`"
    assert describe_type(tuple[bool, ...]) == "a list, each true or false"
    assert describe_type(tuple[str, float]) == "(text; a finite number)"
