"""The table of commands: ``dptse evaluate``, ``dptse train``, ..."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

import dptse_env
from scripts.cli import run

GROUPS = {
    "try": {
        "info": "Print versions, machine and caches, as a bug report needs them.",
        "evaluate": "Evaluate query schedules and policies on the same traffic and noise.",
    },
    "train": {
        "train": "Train a query policy.",
        "train-estimator": "Train a recurrent network as an estimator.",
    },
    "bring your own": {
        "policy": "Import a model of stable-baselines3 as a saved policy.",
        "import": "Import recorded trajectories, a SUMO network or a measured field as a road.",
        "record": "Record traffic with SUMO, so that environments only replay it.",
        "fit": "Fit parameters, estimator and query rule to a road.",
        "tune": "Tune the estimators' settings on training traffic.",
    },
    "judge": {
        "suite": "Score a policy in the cells of the query suite, and write its card.",
        "study": "Play a study, and report on its rows.",
        "audit": "Attack the privacy of an environment.",
        "replay-field": "Replay a measured field of density and speed with the estimators.",
    },
}
"""Commands by what a person wants. Each is a module of this folder with ``Args`` and ``main``."""

MODULES = {name: f"scripts.{name.replace('-', '_')}" for group in GROUPS.values() for name in group}
MODULES["import"] = "scripts.import_road"


def main(words: Sequence[str]) -> None:
    """Run the command that the first word names; an unknown one ends the program with status 2."""
    name, rest = (words[0], words[1:]) if words else ("--help", ())
    if name in ("-h", "--help"):
        print(overview())
    elif name == "--version":
        print(f"dptse {dptse_env.__version__}")
    elif name in MODULES:
        module = importlib.import_module(MODULES[name])
        run(module.main, module.Args, module.__doc__, program=f"dptse {name}", words=rest)
    else:
        known = ", ".join(MODULES)
        print(f"error: there is no command {name!r}, there are {known}", file=sys.stderr)
        raise SystemExit(2)


def overview() -> str:
    """Return the help page: the commands in their groups."""
    lines = [
        "usage: dptse COMMAND ...",
        "",
        "Choose which connected vehicles to query when estimating traffic under differential "
        "privacy.",
    ]
    for group, commands in GROUPS.items():
        lines += ["", f"{group}:"]
        lines += [f"  {name:<16} {meaning}" for name, meaning in commands.items()]
    return "\n".join([*lines, "", "dptse COMMAND --help begins with an example that runs."])


if __name__ == "__main__":
    main(sys.argv[1:])
