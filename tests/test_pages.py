"""Links of pages lead somewhere; all files state the same release."""

import pkgutil
import re
import runpy
import tomllib

import pytest

import dptse_env
from hatch_build import for_package_page
from scripts.dptse import MODULES
from tests.helpers import ROOT

PAGES = sorted(ROOT.glob("*.md"))
LINK = re.compile(r"\]\(([^)\s]+)\)")
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
RULE = re.compile(r"^\|(?: *:?-+:? *\|)+$", re.MULTILINE)  # below the head of a table


def anchors(page):
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {text.replace(" ", "-") for text in plain}


def broken(page):
    """Yield the links of a page that lead nowhere."""
    for link in LINK.findall(CODE.sub("", page.read_text(encoding="utf-8"))):
        if "://" in link or link.startswith("mailto:"):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            yield link


def test_a_moving_picture_is_small_and_has_a_still_beside_it():
    moving = list((ROOT / "docs" / "images").glob("*.webp"))
    assert moving
    for path in moving:
        assert path.stat().st_size < 1_000_000
        assert path.with_suffix(".png").is_file()


def test_what_docstrings_refer_to_is_there():
    for path in (ROOT / "dptse_env").rglob("*.py"):
        for name in re.findall(r"`(dptse_env(?:\.\w+)+)`", path.read_text(encoding="utf-8")):
            if name != "dptse_env.plugins":  # the group of entry points
                pkgutil.resolve_name(name)


def test_tables_of_pages_fit_a_phone():
    studies = [page.parent for page in (ROOT / "results").glob("*/README.md")]  # not a user's
    folders = ROOT / "docs", *studies
    for page in (*PAGES, *(page for each in folders for page in each.rglob("*.md"))):
        for rule in RULE.findall(page.read_text(encoding="utf-8")):
            assert rule.count("|") - 1 <= 6, page


def test_the_page_on_architecture_has_every_command_with_its_modules():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w-]+)[^|]*` \| `(\w+\.py)` \| (.*) \|$", page, re.MULTILINE)
    scripts = {name: module.split(".")[1] + ".py" for name, module in MODULES.items()}
    assert {name: script for name, script, _ in rows} == scripts
    for _, script, work in rows:
        modules = [name.replace(".", "/") for name in re.findall(r"`([\w.]+)`", work)]
        folder = modules[0]
        assert (ROOT / "scripts" / script).is_file()
        for name in modules:
            places = [ROOT / name, ROOT / f"{name}.py", ROOT / folder / f"{name}.py"]
            assert any(place.exists() for place in places), name


@pytest.mark.skipif(not (ROOT / "results").is_dir(), reason="a source archive has no results")
def test_links_lead_somewhere():
    pages = [*PAGES, *(ROOT / "docs").rglob("*.md")]
    assert [(page, link) for page in pages for link in broken(page)] == []


def test_the_site_is_refused_with_dead_links_and_with_files_of_other_hosts(tmp_path):
    (tmp_path / "page.html").write_text(
        '<h1 id="ε">A</h1> <a href="/page.html#%CE%B5">a</a> <a href="#no">b</a> <img src="no.png">'
        '<a href="https://far.example">c</a> <script src="https://far.example/c.js"></script>'
    )
    (tmp_path / "a.css").write_text("a {b: url(https://far.example/d.woff)} c {d: url(e.png)}")
    problems = runpy.run_path(str(ROOT / "docs" / "_site" / "links.py"))["problems"]
    assert sorted(problems(tmp_path)) == [
        "a.css: fetches https://far.example/d.woff",
        "page.html: #no is no anchor",
        "page.html: fetches https://far.example/c.js",
        "page.html: no.png does not exist",
    ]


PAGE = """![a road](docs/road.webp) [`env`](a/env.py), [there](docs/a.md#b), [far](https://far.example).
[below](#below)
```python
tools["a"](b)
```
"""


def test_links_of_the_package_page_lead_to_the_repository_at_a_tag_or_are_words():
    _, rest = PAGE.split("\n", 1)
    assert for_package_page(PAGE, "https://forge.example/a/b/", "v1.2") == (
        "![a road](https://forge.example/a/b/raw/v1.2/docs/road.png) "
        "[`env`](https://forge.example/a/b/blob/v1.2/a/env.py), "
        "[there](https://forge.example/a/b/blob/v1.2/docs/a.md#b), [far](https://far.example).\n"
        + rest
    )
    words = " `env`, there, [far](https://far.example).\n"
    assert for_package_page(PAGE, None, "v1.2") == words + rest


def test_the_paper_has_its_sections_and_cites_what_its_bibliography_has():
    paper, bibliography, citation = (
        (ROOT / name).read_text(encoding="utf-8")
        for name in ("paper/paper.md", "paper/paper.bib", "CITATION.cff")
    )
    _, head, text = paper.split("---\n", 2)
    sections = re.findall(r"^# (.*)$", text, re.MULTILINE)
    assert sections[:4] == ["Summary", "Statement of need", "State of the field", "Software design"]
    assert sections[4:] == ["Research impact statement", "Acknowledgements", "References"]
    assert 750 <= len(text.split()) <= 1_100
    keys = re.findall(r"^@\w+\{(\w+),$", bibliography, re.MULTILINE)
    assert sorted(keys) == sorted(set(re.findall(r"@(\w+)", text)))
    authors = citation.partition("\nreferences:")[0].partition("\nauthors:")[2]
    names = re.findall(r"- name: (.*)", authors)
    assert names
    assert names == re.findall(r"- name: (.*)", head.partition("affiliations:")[0])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert names == [each["name"] for each in project["authors"]]


def test_every_file_states_the_same_version_and_repository():
    project, changelog, citation = (
        (ROOT / name).read_text(encoding="utf-8")
        for name in ("pyproject.toml", "CHANGELOG.md", "CITATION.cff")
    )
    latest = re.search(r"^## \[?([\d.]+)\]? (?:- (.*)|\(unreleased\))$", changelog, re.MULTILINE)
    assert latest is not None
    version, _, is_development = dptse_env.__version__.partition(".dev")
    released = "" if is_development else f"date-released: {latest[2]}\n"
    assert version == latest[1]
    assert f"\nversion: {dptse_env.__version__}\n{released}license:" in citation
    stated = tomllib.loads(project)["project"]
    repository = re.search(r"^repository-code: \"?([^\s\"]*)", citation, re.MULTILINE)
    assert stated.get("urls", {}).get("Repository") == (repository and repository[1])
