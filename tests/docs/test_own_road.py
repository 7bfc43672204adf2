"""The page on a road of one's own, whose blocks run from the road file to a compared policy."""

import contextlib
import io
import shlex
import tomllib
import warnings

import pytest

from tests.scripts.commands import run_command

from .blocks import ROOT, blocks_of
from .test_blocks import commands

END = "## What a fit does"
BLOCKS = blocks_of(ROOT / "docs" / "guides" / "your-road.md")
LINE = (
    (ROOT / "docs" / "guides" / "your-road.md")
    .read_text(encoding="utf-8")
    .partition(END)[0]
    .count("\n")
)


@pytest.mark.slow
def test_the_page_goes_from_a_road_file_to_a_compared_policy(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the extra train is not installed")
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    for block in BLOCKS:
        if block.line > LINE:
            break
        if block.language == "toml":
            (tmp_path / "my-road.toml").write_text(block.text, encoding="utf-8")
        elif block.language == "bash":
            for line in commands(block.text):
                done = run_command(*shlex.split(line)[1:])
                assert done.returncode == 0, done.stderr
        elif block.language == "python":
            with contextlib.redirect_stdout(printed), warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                exec(compile(block.text, str(block), "exec"), {})
    chosen = tomllib.loads((tmp_path / "my-road.toml").read_text(encoding="utf-8"))["environment"]
    assert printed.getvalue().startswith(chosen["estimator"])
    page = (tmp_path / "my-road-fit" / "page.html").read_text(encoding="utf-8")
    assert all(each in page for each in ("dptse train", "dptse evaluate", "dptse tune"))
    comparison = (tmp_path / "my-road-fit" / "comparison" / "tables.md").read_text(encoding="utf-8")
    assert "best" in comparison
