"""Every fenced block of the documentation: Python runs, commands and files are parsed.

The tutorial, the README and the page on extending have tests of their own that run them from top to
bottom. A block under a comment ``<!-- not run: reason -->`` is compiled only.
"""

import importlib
import re
import shlex
import subprocess
import tomllib
from collections import Counter
from pathlib import Path

import pytest
import tyro

from scripts.dptse import COMMANDS, split

from .blocks import BLOCKS, PAGES, ROOT

RUN_ELSEWHERE = {"tutorial.md", "README.md", "extending.md"}
LANGUAGES = {"", "python", "bash", "sh", "toml"}
NAMES = {command.module: name for name, command in COMMANDS.items()}
NOT_RUN = {
    "integrations.md": 1,  # a part of a program that examples/ has whole
    "libraries.md": 1,  # TorchRL is not installed
    "pictures.md": 1,  # a display
}
"""Number of blocks of a page that are compiled only."""


def of(*languages):
    return [pytest.param(each, id=str(each)) for each in BLOCKS if each.language in languages]


def test_blocks_have_a_language_that_is_tested_here_and_few_are_not_run():
    assert {block.language for block in BLOCKS} <= LANGUAGES
    assert Counter(block.page for block in BLOCKS if block.not_run) == NOT_RUN
    assert len(BLOCKS) > 50


@pytest.mark.parametrize("block", of("python"))
def test_python_compiles(block):
    compile(block.text, str(block), "exec")


@pytest.mark.parametrize(
    "page",
    sorted({block.page for block in BLOCKS if block.language == "python"} - RUN_ELSEWHERE),
)
def test_the_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "documentation"}
    for block in BLOCKS:
        if (block.page, block.language) == (page, "python") and not block.not_run:
            if "RecordVideo" in block.text:
                pytest.importorskip("moviepy", reason="the extra video is not installed")
            exec(compile(block.text, str(block), "exec"), names)


@pytest.mark.parametrize("block", of("toml"))
def test_toml_is_valid(block):
    assert tomllib.loads(block.text)


@pytest.mark.parametrize("block", of("bash", "sh"))
def test_commands_are_what_the_programs_take(block):
    subprocess.run(["bash", "-n"], input=block.text, text=True, check=True, capture_output=True)
    for line in block.text.replace("\\\n", " ").splitlines():
        check(line.strip())


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
    elif words[:1] == ["python"] and words[1].startswith("scripts/"):
        parse([*NAMES[Path(words[1]).stem].split(), *words[2:]])
    elif words[:1] == ["python"] and not words[1].startswith("-"):
        assert (ROOT / words[1]).is_file(), line


def parse(words):
    if words[0].startswith("-"):
        assert words in (["--help"], ["--version"])
        return
    if words[-1] == "--help":
        split(words)
        return
    name, rest = split(words)
    module = importlib.import_module(f"scripts.{COMMANDS[name].module}")
    tyro.cli(getattr(module, COMMANDS[name].arguments), args=rest)


def test_a_command_with_an_unknown_option_would_be_noticed(capsys):
    for line in (
        "python scripts/record.py --sedes 0:4",
        "dptse trian --seed 0",
        "dptse evaluate --seeds",
    ):
        with pytest.raises(SystemExit) as ended:
            check(line)
        assert ended.value.code == 2


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_inline_commands_name_programs_that_exist(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`(?:python )?scripts/(\w+)\.py", text):
        assert (ROOT / "scripts" / f"{name}.py").is_file(), name
    for name in re.findall(r"`dptse ([a-z][a-z-]*)", text):
        assert any(known.split()[0] == name for known in COMMANDS), name
