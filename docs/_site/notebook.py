"""Write the tutorial as a notebook: docs/tutorial.ipynb.

python docs/_site/notebook.py

Where `[project.urls]` of pyproject.toml has the Repository, the tutorial gets a link that opens the
notebook in Colab, and the first cell of the notebook installs the package from there.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

ROOT = Path(__file__).parents[2]
LINK = "[tutorial.ipynb](tutorial.ipynb)"
COLAB = "https://colab.research.google.com/github{}/blob/main/docs/tutorial.ipynb"
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
    text = re.sub(r"\\\n *", "", text)
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


def repository() -> str | None:
    """Return the address of the repository, if there is one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    address: str | None = project.get("urls", {}).get("Repository")
    return address


def with_colab(page: str, address: str | None) -> str:
    """Return the tutorial with a link to Colab, or without one where there is no repository."""
    plain = re.sub(r",\nor \[open it in Colab\]\(\S+\)", "", page)
    if address is None:
        return plain
    place = COLAB.format(urlsplit(address).path.rstrip("/"))
    return plain.replace(LINK, f"{LINK},\nor [open it in Colab]({place})")


def notebook_text() -> str:
    """Return the notebook of the tutorial as text; one of a repository installs it from there."""
    page = TUTORIAL.read_text(encoding="utf-8")
    if address := repository():
        page = page.replace("'.[train]'", f"'dptse-env[train] @ git+{address}'")
    notebook = make_notebook(page)
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    page = TUTORIAL.read_text(encoding="utf-8")
    TUTORIAL.write_text(with_colab(page, repository()), encoding="utf-8")
    NOTEBOOK.write_text(notebook_text(), encoding="utf-8")
    print(f"wrote {NOTEBOOK}")
