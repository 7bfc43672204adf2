"""The tutorial runs as a notebook in a kernel, from the first cell to the last."""

import os
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "docs" / "tutorial.ipynb"


@pytest.mark.slow
def test_the_notebook_runs_in_a_kernel(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the extra train is not installed")
    # Its commands are those of this environment, where the package is installed.
    programs = str(Path(sys.executable).parent)
    monkeypatch.setenv("PATH", programs + os.pathsep + os.environ["PATH"])
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    cells = [cell for cell in notebook.cells if not cell.source.startswith("!pip install")]
    assert len(cells) == len(notebook.cells) - 1
    notebook.cells = cells
    place = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=1200, resources=place).execute()
    text = str([cell.outputs for cell in cells if cell.cell_type == "code"])
    assert "(5, 0.05)-differential privacy" in text
    assert "mean error 0." in text
    assert "it asks segments [" in text
    assert "error:" not in text
    assert (tmp_path / "results/learned/page.html").is_file()
    assert (tmp_path / "results/learned/space_time.png").is_file()
    assert "mine:Fastest" in (tmp_path / "results/fastest/tables.md").read_text()
