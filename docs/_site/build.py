"""Build the documentation site, build/site, and check it: python docs/_site/build.py.

Pages and what they link to are copied to build/pages, where links lead from page to page. Lines
``::: keywords CLASS`` and ``::: commands`` become tables of what the code declares, and the note on
such lines, which is for readers of the repository, is dropped.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from links import problems
from reference import command_list, keyword_table

ROOT = Path(__file__).parents[2]
PAGES, SITE = ROOT / "build" / "pages", ROOT / "build" / "site"
CODE = re.compile(r"(```.*?^ *```|`[^`\n]+`)", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)[^)\s#]+")
TABLE = re.compile(r"^::: (keywords|commands) ?(.*)$", re.MULTILINE)

NOTE = re.compile(r"^> A line with `:::`.*\n\n", re.MULTILINE)


def sources() -> dict[Path, Path]:
    """Return the files that the site is made of, and the place of each in the site."""
    docs = ROOT / "docs"
    files = [path for path in docs.rglob("*") if path.is_file() and "_site" not in path.parts]
    found = {path: path.relative_to(docs) for path in files}
    found |= {path: path.relative_to(ROOT) for path in ROOT.glob("results/*/*.md")}
    beside = ("CONTRIBUTING.md", "CHANGELOG.md")
    return found | {ROOT / name: Path(name.lower()) for name in beside}


def prepare() -> None:
    """Write the pages anew, and copy what they link to.

    Raises:
        FileNotFoundError: A page links to a file that does not exist.
    """
    places = sources()
    shutil.rmtree(PAGES, ignore_errors=True)
    for source in [path for path in places if path.suffix == ".md"]:

        def lead(link: re.Match[str], source: Path = source) -> str:
            target = Path(os.path.normpath(source.parent / link[0]))
            if not target.is_file():
                raise FileNotFoundError(f"{source.relative_to(ROOT)}: there is no file {link[0]}")
            place = places.setdefault(target, target.relative_to(ROOT))
            return os.path.relpath(place, places[source].parent)

        text = NOTE.sub("", source.read_text(encoding="utf-8"))
        parts = CODE.split(TABLE.sub(_table, text))
        parts[::2] = [LINK.sub(lead, part) for part in parts[::2]]
        page = PAGES / places[source]
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text("".join(parts), encoding="utf-8")
    for source, place in places.items():
        if source.suffix != ".md":
            (PAGES / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, PAGES / place)


def _table(line: re.Match[str]) -> str:
    return keyword_table(line[2]) if line[1] == "keywords" else command_list()


def main() -> None:
    """Build the site; a link that leads nowhere ends the program with status 1."""
    try:
        prepare()
    except FileNotFoundError as problem:
        sys.exit(f"error: {problem}")
    shutil.rmtree(SITE, ignore_errors=True)
    command = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    if subprocess.run(command, cwd=ROOT, check=False).returncode:
        sys.exit(1)
    if found := sorted(problems(SITE)):
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
