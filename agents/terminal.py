"""Tables for a terminal or a pipe, in which no number is ever cut, and lines for a file."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

told = logging.getLogger("dptse")
"""Tells files, which have no bars, how far long work is."""

_UNLIMITED = 100_000


def make_table(
    title: str, *columns: str, left: int = 1, rows: Iterable[Sequence[str]] = ()
) -> Table:
    """Return a table; the first ``left`` columns are left-aligned, numbers go right."""
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    for place, header in enumerate(columns):
        table.add_column(header, justify="left" if place < left else "right")
    for row in rows:
        table.add_row(*row)
    return table


def print_table(table: Table) -> None:
    """Print a table with every number whole.

    In a pipe the table takes the width that it needs. In a terminal that is too narrow, headers
    fold and cells wrap between words; a table whose words alone are wider than the terminal runs
    over.
    """
    console = Console()
    for column in table.columns:
        column.overflow = "fold"
        words = [word for cell in column.cells for word in str(cell).split()]
        column.min_width = max(map(len, words), default=1)
    if not console.is_terminal:
        needed = Measurement.get(console, console.options.update(max_width=_UNLIMITED), table)
        console.width = max(console.width, needed.maximum)
    console.print(table, crop=False)
