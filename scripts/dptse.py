"""The table of commands: ``dptse evaluate``, ``dptse train``, ..."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

import dptse_env

GROUPS = {
    "try": {
        "evaluate": "compare policies and estimators on traffic",
        "info": "print versions and caches for a bug report",
    },
    "train": {
        "train": "train a query policy",
        "train-estimator": "train the recurrent network",
    },
    "bring your own": {
        "import": "import trajectories, nets, fields, policies",
        "record": "record traffic with SUMO ahead of time",
        "fit": "fit parameters, estimator and policy to a road",
    },
    "study": {
        "study": "run a study and write its report",
        "audit": "attack the privacy of an environment",
    },
}
"""Commands by what a person wants. Each is a module of this folder with ``Args`` and ``main``."""

ANEW = ("audit", "import", "info")
"""Commands that begin anew after an interruption, as evaluate does with --force."""

MODULES = {name: f"scripts.{name.replace('-', '_')}" for group in GROUPS.values() for name in group}
MODULES["import"] = "scripts.imports"


def main(words: Sequence[str]) -> None:
    """Run the command that the first word names; an unknown one ends the program with status 2."""
    name, rest = (words[0], words[1:]) if words else ("help", ())
    if name == "help" and rest:
        name, rest = rest[0], (*rest[1:], "--help")
    if name in ("-h", "--help", "help"):
        print(overview())
    elif name == "--version":
        print(f"dptse {dptse_env.__version__}")
    elif name in MODULES:
        from scripts.cli import run  # noqa: PLC0415  (slow to import)

        module = importlib.import_module(MODULES[name])
        program = f"dptse {name}"
        # A search of settings goes on with its trials all the same.
        resumes = name not in ANEW and (name == "fit" or "--force" not in rest)
        run(module.main, module.Args, module.__doc__, program=program, words=rest, resumes=resumes)
    else:
        known = ", ".join(MODULES)
        print(f"error: {name!r} is no command; there are {known}", file=sys.stderr)
        raise SystemExit(2)


def overview() -> str:
    """Return the help page: the commands in their groups."""
    lines = ["usage: dptse COMMAND [OPTIONS]"]
    for group, commands in GROUPS.items():
        first, *others = (f"{name:<16} {meaning}" for name, meaning in commands.items())
        lines += ["", f"{group:<16}{first}", *(f"{'':<16}{other}" for other in others)]
    return "\n".join([*lines, "", "dptse help COMMAND begins with an example that runs."])


if __name__ == "__main__":
    main(sys.argv[1:])
