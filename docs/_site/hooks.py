"""Hooks of the documentation site: what lies outside of the folder of pages."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
SHOWN = ("results/*/*.md", "results/*/*.png", "examples/**/*.*")
"""Files outside of the folder of pages that are part of the site."""

ELSEWHERE = {
    "../dptse_env/spaces/actions.py": "reference/spaces.md",
    "../results": "results.md",
    "../examples": "train-a-policy.md",
}
"""Pages of the site for links that lead to a file or folder of the repository."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add results, their figures and example files."""
    for pattern in SHOWN:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Lead links to the repository's other folders to where the site has them."""

    def lead(found: re.Match[str]) -> str:
        target = found[1]
        if target in ELSEWHERE:
            return f"]({ELSEWHERE[target]})"
        return f"]({target.removeprefix('../')})"

    if "/" in page.file.src_uri:
        return markdown
    return re.sub(r"\]\((\.\./[^)\s]+)\)", lead, markdown)
