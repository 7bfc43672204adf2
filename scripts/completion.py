"""Print a script that completes the commands of dptse and their options in a shell.

python scripts/completion.py bash > ~/.local/share/bash-completion/completions/dptse
python scripts/completion.py zsh > ~/.zfunc/_dptse
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union

import tyro

from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """Print a script for a shell."""

    shell: Annotated[Literal["bash", "zsh", "tcsh"], tyro.conf.Positional]
    """The shell."""


def all_arguments() -> Any:
    """Return the arguments of all commands, as subcommands of one program."""
    from scripts.dptse import COMMANDS  # noqa: PLC0415 (that module names this one)

    single: list[Any] = []
    groups: dict[str, list[Any]] = {}
    for name, command in COMMANDS.items():
        arguments = getattr(importlib.import_module(f"scripts.{command.module}"), command.arguments)
        group, _, rest = name.partition(" ")
        where = groups.setdefault(group, []) if rest else single
        subcommand = tyro.conf.subcommand(rest or group, description=command.meaning)
        where.append(Annotated[arguments, subcommand])
    for group, members in groups.items():
        single.append(Annotated[Union[tuple(members)], tyro.conf.subcommand(group)])  # noqa: UP007
    return Union[tuple(single)]  # noqa: UP007


def main(args: Args) -> None:
    """Print the script; tyro ends the program after it."""
    tyro.cli(all_arguments(), prog="dptse", args=["--tyro-print-completion", args.shell])


if __name__ == "__main__":
    run(main, Args, __doc__)
