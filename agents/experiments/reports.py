"""Reports: Markdown templates, filled with tables and numbers.

A template is English prose that a person can edit. A name in it without a value is an error.
Filters: ``interval`` (a mean with its interval), ``number`` (three significant digits), ``plain``
(a number without trailing zeros), ``integers`` (a range of integers).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from agents.evaluation.episodes import WARM_UP
from agents.experiments.old_tables import (
    format_interval,
    format_number,
    format_range,
    settings_table,
    versions_table,
)
from agents.files import write_atomically

TEMPLATE, REPORT = "report.md.j2", "REPORT.md"


def fill(folder: Path, content: Mapping[str, Any], name: str = TEMPLATE) -> str:
    """Return a template of a folder, filled.

    Args:
        folder: Folder of the template; templates beside this module can be included.
        content: Values of the names in the template.
        name: File name of the template.

    Raises:
        jinja2.UndefinedError: The template uses a name that has no value.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, Path(__file__).parent]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals |= {
        "WARM_UP": WARM_UP,
        "versions_table": versions_table,
        "settings_table": settings_table,
    }
    environment.filters |= {
        "interval": format_interval,
        "number": format_number,
        "integers": format_range,
        "plain": "{:g}".format,
    }
    return environment.get_template(name).render(content)


def write_report(folder: Path, template_folder: Path, content: Mapping[str, Any]) -> None:
    """Write the filled report template of a study to a folder of results."""
    write_atomically(folder / REPORT, fill(template_folder, content))
