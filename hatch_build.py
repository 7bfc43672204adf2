"""The README for a package page, which resolves no links of the repository and plays no picture."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|mailto:|#)([^)\s]+)\)")
CODE = re.compile(r"(```.*?```)", re.DOTALL)


class PackagePage(MetadataHookInterface):
    """Leads the README's links to the repository of ``[project.urls]``, at the version's tag."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the readme."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = metadata.get("urls", {}).get("Repository")
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": for_package_page(text, repository, f"v{metadata['version']}"),
        }


def for_package_page(text: str, repository: str | None, tag: str) -> str:
    """Return a page whose links and pictures need no repository around it.

    Args:
        text: The page in Markdown.
        repository: Address of the repository. Without one, the text of a link stays, and a
            picture goes.
        tag: Tag that the links lead to.
    """

    def lead(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        if repository is None:
            return "" if picture else words
        if picture:
            target = re.sub(r"\.webp$", ".png", target)  # the still beside a moving picture
        kind = "raw" if picture else "blob"
        return f"{picture}[{words}]({repository.rstrip('/')}/{kind}/{tag}/{target})"

    return "".join(
        part if part.startswith("```") else LINK.sub(lead, part) for part in CODE.split(text)
    )
