"""The tools as commands of one program: ``dptse record``, ``dptse train``, ...

python scripts/dptse.py record --seeds 0:64
"""

from __future__ import annotations

import difflib
import importlib
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import dptse_env
from scripts.cli import run

PROGRAM = "dptse"


@dataclass(frozen=True)
class Command:
    """A command: a module, and what it does in one line.

    Attributes:
        arguments: Name in the module of its arguments.
    """

    module: str
    meaning: str
    arguments: str = "Args"


COMMANDS: Mapping[str, Command] = {
    "info": Command("info", "Print versions, machine and caches, as a bug report needs them."),
    "record": Command("record", "Record traffic with SUMO, so that environments only replay it."),
    "import trajectories": Command(
        "import_road", "Import recorded trajectories as records of a road.", "Trajectories"
    ),
    "import network": Command("import_network", "Make a road of a SUMO network."),
    "import field": Command(
        "import_road", "Import a measured field of density and speed.", "Field"
    ),
    "calibrate": Command("calibrate", "Fit the ARZ parameters to recorded traffic."),
    "tune": Command("tune", "Tune the estimators' settings."),
    "train": Command("train", "Train a query policy."),
    "train-estimator": Command("train_estimator", "Train a recurrent network as an estimator."),
    "evaluate": Command("evaluate", "Evaluate schedules and policies on the same traffic."),
    "suite": Command("suite", "Score policies in the tasks of the query suite."),
    "audit": Command("audit", "Attack the privacy of an environment."),
    "study": Command("study", "Play a study, or report the rows of one."),
    "replay-field": Command("replay_field", "Replay a measured field with the estimators."),
    "completion": Command("completion", "Print a script that completes commands in a shell."),
}


def main(words: Sequence[str]) -> None:
    """Run the command that the first words name; unknown ones end the program with status 2."""
    if not words or words[0] in ("-h", "--help"):
        print(overview())
        return
    if words[0] == "--version":
        print(f"{PROGRAM} {dptse_env.__version__}")
        return
    name, rest = split(words)
    command = COMMANDS[name]
    module = importlib.import_module(f"scripts.{command.module}")
    run(
        module.main,
        getattr(module, command.arguments),
        as_commands(module.__doc__ or ""),
        program=f"{PROGRAM} {name}",
        words=rest,
    )


def split(words: Sequence[str]) -> tuple[str, Sequence[str]]:
    """Return the command and the words after it.

    Raises:
        SystemExit: There is no such command; the nearest is printed.
    """
    for n in (2, 1):
        name = " ".join(words[:n])
        if name in COMMANDS:
            return name, words[n:]
    groups = [name for name in COMMANDS if name.split()[0] == words[0]]
    if groups and (len(words) == 1 or words[1] in ("-h", "--help")):
        print(overview(groups))
        raise SystemExit(0 if len(words) > 1 else 2)
    tried = " ".join(words[: 2 if groups else 1])
    # "impot network" is nearest to a command of two words, "evalaute x" to one of one.
    meant = " ".join(words[:2]) if len(words) > 1 else tried
    nearest = [
        *difflib.get_close_matches(meant, COMMANDS, n=1, cutoff=0.8),
        *difflib.get_close_matches(tried, COMMANDS, n=1, cutoff=0.5),
    ]
    hint = f", did you mean {nearest[0]!r}?" if nearest else ""
    print(f"error: there is no command {tried!r}{hint} See {PROGRAM} --help.", file=sys.stderr)
    raise SystemExit(2)


def overview(names: Sequence[str] = tuple(COMMANDS)) -> str:
    """Return the help page of some commands."""
    width = max(map(len, names))
    lines = [f"  {name:<{width}}  {COMMANDS[name].meaning}" for name in names]
    return "\n".join(
        [
            f"usage: {PROGRAM} [--version] COMMAND ...",
            "",
            "Choose which connected vehicles to query when estimating traffic under differential "
            "privacy.",
            "",
            "commands:",
            *lines,
            "",
            f"{PROGRAM} COMMAND --help shows the options of a command.",
        ]
    )


def as_commands(text: str) -> str:
    """Return a text in which scripts are named as commands."""
    # A script of several commands has their last words as subcommands.
    names = {
        command.module: name if command.arguments == "Args" else name.split()[0]
        for name, command in COMMANDS.items()
    }
    return re.sub(
        r"python scripts/(\w+)\.py",
        lambda found: f"{PROGRAM} {names[found[1]]}" if found[1] in names else found[0],
        text,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
