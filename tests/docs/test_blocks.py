"""Every fenced block of the documentation: Python runs, commands and files are parsed.

The README, the tutorial and the guides with commands have tests of their own that run them from top
to bottom.
A block under a comment ``<!-- not run: reason -->`` is compiled only.
"""

import importlib
import re
import shlex
import tomllib
from xml.etree import ElementTree

import pytest
import tyro

from scripts.dptse import MODULES
from tests.helpers import ROOT, fast_and_slow

from .blocks import BLOCKS, PAGES, commands
from .test_guides import GUIDES

RUN_ELSEWHERE = {"README.md", "tutorial.md", "your-own-part.md", *GUIDES}
RUN = {block.page for block in BLOCKS if block.language == "python"} - RUN_ELSEWHERE


def test_blocks_are_of_languages_that_are_tested_here_and_can_be_parsed():
    for block in BLOCKS:
        assert block.language in {"", "python", "bash", "sh", "toml", "xml"}, block
        if block.language == "python":
            compile(block.text, str(block), "exec")
        if block.language == "toml":
            assert tomllib.loads(block.text), block
        if block.language == "xml":
            ElementTree.fromstring(block.text)
        if block.language in ("bash", "sh"):
            for line in commands(block.text):
                check(line)


def test_pages_install_from_the_checkout_since_no_index_has_the_name():
    named = {page.name for page in PAGES if "dptse-env[" in page.read_text(encoding="utf-8")}
    assert named == {"install.md"}


@pytest.mark.parametrize("page", fast_and_slow(sorted(RUN), RUN - {"pictures.md"}))
def test_the_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "documentation"}
    for block in BLOCKS:
        if (block.page, block.language) == (page, "python") and not block.not_run:
            if "RecordVideo" in block.text:
                pytest.importorskip("moviepy", reason="the extra video is not installed")
            exec(compile(block.text, str(block), "exec"), names)


def check(line):
    """Parse one command line, with the parser of its program or the rules of make."""
    if "$" in line:  # of a function of the shell, with arguments that only the shell knows
        return
    words = shlex.split(line, comments=True)
    if words[:1] == ["make"]:
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        goals = [word for word in words[1:] if "=" not in word and not word.startswith("-")]
        assert set(goals) <= set(targets), line
    elif words[:1] == ["dptse"]:
        parse(words[1:])
    elif words[:1] == ["python"] and not words[1].startswith("-"):
        assert (ROOT / words[1]).is_file(), line


def parse(words):
    if not {"--help", "--version"} & {*words}:
        arguments = importlib.import_module(MODULES[words[0]]).Args
        tyro.cli(arguments, args=words[1:])


def test_inline_commands_name_programs_that_exist():
    for page in PAGES:
        for name in re.findall(r"`dptse ([a-z][a-z-]*)", page.read_text(encoding="utf-8")):
            assert name in {*MODULES, "help"}, (page, name)
