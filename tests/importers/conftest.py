"""Imports without the picture of their report, which takes most of the time of small ones."""

import pytest


@pytest.fixture(autouse=True, scope="module")
def no_picture():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dptse_env.importers.report._draw", lambda *_: None)
        yield
