"""Write the tutorial as a notebook: docs/tutorial.ipynb.

python docs/_site/notebook.py
"""

import json
import re
from pathlib import Path
from typing import Any

TUTORIAL = Path(__file__).parents[1] / "tutorial.md"
NOTEBOOK = TUTORIAL.with_suffix(".ipynb")
BLOCK = re.compile(r"```(\w+)(?: title=\"([\w.]+)\")?\n(.*?)```\n?", re.DOTALL)


def make_notebook(page: str) -> dict[str, Any]:
    """Return a notebook of a page's texts and blocks."""
    cells: list[dict[str, Any]] = []
    position = 0
    for found in BLOCK.finditer(page):
        _add(cells, "markdown", page[position : found.start()])
        _add(cells, "code", _code(*found.groups()))
        position = found.end()
    _add(cells, "markdown", page[position:])
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _code(language: str, file: str | None, text: str) -> str:
    """Return a block as a cell: a file that is written, commands of the shell, or Python."""
    if file:
        return f"%%writefile {file}\n{text}"
    if language == "python":
        return text
    # A notebook runs in the environment that it was started from.
    lines = [line for line in text.splitlines() if "venv" not in line]
    return "\n".join(f"!{line}" for line in lines)


def _add(cells: list[dict[str, Any]], kind: str, text: str) -> None:
    if not text.strip():
        return
    cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{len(cells)}", "metadata": {}}
    if kind == "code":
        cell |= {"execution_count": None, "outputs": []}
    cells.append({**cell, "source": text.strip("\n").splitlines(keepends=True)})


def notebook_text() -> str:
    """Return the notebook of the tutorial as text."""
    notebook = make_notebook(TUTORIAL.read_text(encoding="utf-8"))
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    NOTEBOOK.write_text(notebook_text(), encoding="utf-8")
    print(f"wrote {NOTEBOOK}")
