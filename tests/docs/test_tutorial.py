"""The tutorial, and the notebook that is made of it."""

import json
import runpy
from pathlib import Path

from .blocks import blocks_of

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"
BLOCKS = blocks_of(TUTORIAL)


def test_the_notebook_is_the_tutorial():
    path = TUTORIAL.parent / "_site" / "notebook.py"
    code = runpy.run_path(str(path))
    assert code["NOTEBOOK"].read_text(encoding="utf-8") == code["notebook_text"]()
    cells = json.loads(code["notebook_text"]())["cells"]
    shown = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert len(shown) == len(BLOCKS)
    for text in shown:
        if text[0] not in "!%":
            compile(text, "cell", "exec")
