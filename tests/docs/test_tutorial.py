"""The tutorial, and the notebook that is made of it."""

import json
import runpy
from pathlib import Path

from .blocks import blocks_of

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"
BLOCKS = blocks_of(TUTORIAL)


def test_it_takes_a_newcomer_few_commands():
    shell = [block.text for block in BLOCKS if block.language == "bash"]
    assert sum(len(text.splitlines()) for text in shell) <= 8


def test_the_notebook_is_the_tutorial():
    path = TUTORIAL.parent / "_site" / "notebook.py"
    code = runpy.run_path(str(path))
    assert code["NOTEBOOK"].read_text(encoding="utf-8") == code["notebook_text"]()
    cells = json.loads(code["notebook_text"]())["cells"]
    shown = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert len(shown) == len(BLOCKS)
    assert sum(text.startswith("!dptse") for text in shown) == 4
    assert any(text.startswith("%%writefile mine.py") for text in shown)
    for text in shown:
        if text[0] not in "!%":
            compile(text, "cell", "exec")
