"""The tutorial, and the notebook that is made of it, which runs from the first cell to the last."""

import os
import runpy
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from .blocks import blocks_of

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOK = nbformat.read(DOCS / "tutorial.ipynb", as_version=4)


def test_the_notebook_is_the_tutorial():
    code = runpy.run_path(str(DOCS / "_site" / "notebook.py"))
    assert code["NOTEBOOK"].read_text(encoding="utf-8") == code["notebook_text"]()
    page = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    assert code["with_colab"](page, code["repository"]()) == page
    there = code["with_colab"](page, "https://forge.example/a/b/")
    assert "/github/a/b/blob/main/docs/tutorial.ipynb)" in there
    assert code["with_colab"](there, None) == code["with_colab"](page, None)
    shown = [cell.source for cell in NOTEBOOK.cells if cell.cell_type == "code"]
    assert len(shown) == len(blocks_of(DOCS / "tutorial.md"))
    for text in shown:
        if text[0] not in "!%":
            compile(text, "cell", "exec")


@pytest.mark.slow
def test_the_notebook_runs_in_a_kernel(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the extra train is not installed")
    # Its commands are those of this environment, where the package is installed.
    programs = str(Path(sys.executable).parent)
    monkeypatch.setenv("PATH", programs + os.pathsep + os.environ["PATH"])
    cells = [cell for cell in NOTEBOOK.cells if not cell.source.startswith("!pip install")]
    assert len(cells) == len(NOTEBOOK.cells) - 1
    NOTEBOOK.cells = cells
    place = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(NOTEBOOK, timeout=1200, resources=place).execute()
    text = str([cell.outputs for cell in cells if cell.cell_type == "code"])
    assert "(5, 0.05)-differential privacy" in text
    assert "mean error 0." in text
    assert "the policy queries segment " in text
    assert "error:" not in text
    assert (tmp_path / "results/learned/page.html").is_file()
    assert (tmp_path / "results/learned/space_time.png").is_file()
    tables = (tmp_path / "results/fastest/tables.md").read_text(encoding="utf-8")
    assert "mine:Fastest" in tables
