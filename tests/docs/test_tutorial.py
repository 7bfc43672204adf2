"""The tutorial, from top to bottom, in an empty folder."""

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"
BLOCK = re.compile(r"```(\w+)(?: title=\"([\w.]+)\")?\n(.*?)```", re.DOTALL)
DPTSE = "import dptse_env.command_line as c; c.main()"


def blocks():
    return BLOCK.findall(TUTORIAL.read_text(encoding="utf-8"))


def test_it_takes_a_newcomer_few_commands():
    shell = [text for language, _, text in blocks() if language == "bash"]
    assert sum(len(text.splitlines()) for text in shell) <= 8


def test_the_notebook_is_the_tutorial():
    path = TUTORIAL.parent / "_site" / "notebook.py"
    code = runpy.run_path(str(path))
    assert code["NOTEBOOK"].read_text(encoding="utf-8") == code["notebook_text"]()
    cells = json.loads(code["notebook_text"]())["cells"]
    shown = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert len(shown) == len(blocks())
    assert sum(text.startswith("!dptse") for text in shown) == 4
    assert any(text.startswith("%%writefile mine.py") for text in shown)
    for text in shown:
        if text[0] not in "!%":
            compile(text, "cell", "exec")


@pytest.mark.slow
def test_it_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    names = {}
    for language, file, text in blocks():
        if file:
            (tmp_path / file).write_text(text)
        elif language == "python":
            exec(text, names)
        else:
            for line in text.splitlines():
                if line.startswith("dptse "):
                    run(line, tmp_path)
    printed = capsys.readouterr().out
    assert "(5, 0.05)-differential privacy" in printed
    assert "mean error 0." in printed
    assert "it asks segments [" in printed
    assert (tmp_path / "results/learned/space_time.png").is_file()
    assert (tmp_path / "results/learned/page.html").is_file()
    assert "mine:Fastest" in (tmp_path / "results/fastest/summary.json").read_text()


def run(line, folder):
    """Run a command as the installed program would."""
    words = [sys.executable, "-c", DPTSE, *line.split()[1:]]
    done = subprocess.run(
        words, cwd=folder, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
