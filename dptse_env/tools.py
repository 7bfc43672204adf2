"""The folder of the tools, the top-level packages ``agents`` and ``scripts`` of the repository.

A wheel has them in a folder of this package, so that an installation adds no packages of these
names. The folder is put on the path when a tool runs; a program of one's own does it so::

    from dptse_env.tools import add_tools_path

    add_tools_path()
    from agents.play import Cell
"""

import sys
from pathlib import Path

_PACKAGE = Path(__file__).parent
_IN_A_WHEEL = _PACKAGE / "_tools"

TOOLS = _IN_A_WHEEL if _IN_A_WHEEL.is_dir() else _PACKAGE.parent
"""Folder that has ``agents`` and ``scripts``: that of a wheel, or the checkout."""


def add_tools_path() -> None:
    """Make the tools importable in this process; worker processes inherit the path, or call it."""
    if str(TOOLS) not in sys.path:
        sys.path.insert(0, str(TOOLS))
