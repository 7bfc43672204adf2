"""The README: its Python prints what stands below it, and it is short."""

import contextlib
import io

from tests.helpers import ROOT

from .blocks import blocks_of

README = ROOT / "README.md"
BLOCKS = blocks_of(README)


def test_it_is_read_in_three_minutes():
    assert len(README.read_text(encoding="utf-8").split()) <= 700


def test_the_python_prints_the_block_below_it():
    python = [k for k, block in enumerate(BLOCKS) if block.language == "python"]
    assert python
    for k in python:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(BLOCKS[k].text, str(BLOCKS[k]), "exec"), {})
        assert BLOCKS[k + 1].language == ""
        assert printed.getvalue() == BLOCKS[k + 1].text
