"""Statements about a release: the README on a package page, the version, the repository."""

import re
import tomllib
from pathlib import Path

import dptse_env
from hatch_build import for_package_page

ROOT = Path(__file__).parents[1]
PAGE = """![a road](docs/road.png) [`env`](a/env.py), [there](docs/a.md#b), [far](https://far.example).
[below](#below)
```python
tools["a"](b)
```
"""


def test_links_lead_to_the_repository_at_a_tag():
    assert for_package_page(PAGE, "https://forge.example/a/b/", "v1.2") == (
        "![a road](https://forge.example/a/b/raw/v1.2/docs/road.png) "
        "[`env`](https://forge.example/a/b/blob/v1.2/a/env.py), "
        "[there](https://forge.example/a/b/blob/v1.2/docs/a.md#b), [far](https://far.example).\n"
        '[below](#below)\n```python\ntools["a"](b)\n```\n'
    )


def test_without_a_repository_their_words_stay():
    assert for_package_page(PAGE, None, "v1.2") == (
        " `env`, there, [far](https://far.example).\n"
        '[below](#below)\n```python\ntools["a"](b)\n```\n'
    )


def test_every_file_states_the_same_version():
    project, changelog, citation = (
        (ROOT / name).read_text(encoding="utf-8")
        for name in ("pyproject.toml", "CHANGELOG.md", "CITATION.cff")
    )
    latest = re.search(r"^## \[(\d.*)\] - (.*)$", changelog, re.MULTILINE)
    assert latest is not None
    assert tomllib.loads(project)["project"]["version"] == dptse_env.__version__ == latest[1]
    assert f"\nversion: {latest[1]}\ndate-released: {latest[2]}\n" in citation


def test_the_citation_names_the_same_repository():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    repository = project.get("urls", {}).get("Repository")
    stated = [
        line.split(maxsplit=1)[1].strip('"')
        for line in (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
        if line.startswith("repository-code:")
    ]
    assert stated == ([] if repository is None else [repository])
