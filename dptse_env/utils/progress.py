"""Progress bars: on a terminal alone, and none where a program is to be quiet."""

from __future__ import annotations

from typing import Any

from tqdm import tqdm

_quiet = False


def set_quiet(quiet: bool) -> None:
    """Show no bars of this process, or show them again."""
    global _quiet  # noqa: PLW0603 (one process has one terminal)
    _quiet = quiet


def make_bar(total: float, *, shown: bool = True, **options: Any) -> tqdm[Any]:
    """Return a progress bar, which a pipe or a file gets nothing of.

    Args:
        total: Units until it is full.
        shown: False for none.
        **options: Further ones of `tqdm.tqdm`.
    """
    return tqdm(total=total, disable=None if shown and not _quiet else True, **options)
