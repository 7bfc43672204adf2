"""Use an installed wheel without some of its extras: what wants one says which, in one sentence."""

import importlib
import json
import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym

import dptse_env
from dptse_env.tools import add_tools_path
from dptse_env.utils.registry import MissingExtraError

SHORT = ["--env", "dptse_env:dptse/ShortHighway-v0"]
LONGER = {"n_mainline": 7}
"""A corridor whose net does not come with the package."""

WITHOUT_EXTRAS = {
    "train": [[], ["--version"], ["info"], ["evaluate", "--help"], ["import", "network"]],
}
WITH_TRAIN = {
    "corridors": [
        ["record", "--env", f"{SHORT[1]} {json.dumps({'corridor': LONGER})}", "--train-seeds", "0"],
    ],
    "ray": [
        ["evaluate", "--suite", "--policies", "static", "--executor", "ray"],
        ["evaluate", "--executor", "ray", "--test-seeds", "2000:2002", "--output", "ladder"],
    ],
}
"""Commands by the extra that they lack, where the extra `train` is installed."""


def main(with_train: bool) -> None:
    """Import every module, and call what wants an extra that is not installed."""
    add_tools_path()
    packages = ("dptse_env", "agents", "scripts") if with_train else ("dptse_env",)
    lacking = {name: extra for package in packages for name, extra in lacks(package).items()}
    print(f"modules that want an extra: {lacking}")
    reference = {"dptse_env.estimators.reference": "reference"}
    if with_train:
        assert lacking == reference, lacking
    else:
        train = dict.fromkeys(("dptse_env.importers", "dptse_env.sb3"), "train")
        assert lacking == reference | train, lacking
        for package in ("agents", "scripts"):
            assert lacks(package) == {package: "train"}
    check_environments(with_train)
    for extra, commands in (WITH_TRAIN if with_train else WITHOUT_EXTRAS).items():
        for words in commands:
            check_command(extra, words)


def lacks(package: str) -> dict[str, str]:
    """Import the modules of a package; return the extra that each lacks, if any.

    Raises:
        ImportError: A module lacks something, and does not say which extra brings it.
    """
    found, names = {}, [package]
    while names:
        name = names.pop()
        if extra := wanted(importlib.import_module, name):
            found[name] = extra
            continue
        below = pkgutil.iter_modules(getattr(sys.modules[name], "__path__", []), f"{name}.")
        names += [each.name for each in below if not each.name.endswith(".__main__")]
    return found


def wanted(use: Callable[..., Any], *args: Any, **keywords: Any) -> str:
    """Return the extra that a call lacks, empty for none."""
    try:
        use(*args, **keywords)
    except MissingExtraError as problem:
        return extra_of(str(problem))
    return ""


def check_environments(with_train: bool) -> None:
    """Use a road whose net has to be compiled, a window, and pictures."""
    env = gym.make(SHORT[1], corridor=LONGER, bandwidth=1)
    assert wanted(env.reset, seed=0) == "corridors"
    assert wanted(gym.make, SHORT[1], render_mode="human") == "video"
    if with_train:
        env = gym.make(SHORT[1], render_mode="rgb_array")
        env.reset(seed=0)
        assert env.render().std() > 0
    else:
        assert wanted(gym.make, SHORT[1], render_mode="rgb_array") == "plot"


def check_command(extra: str, words: list[str]) -> None:
    """Run a command of ``dptse``, which must name an extra and fail."""
    program = Path(sys.executable).with_name("dptse")
    ended = subprocess.run([program, *words], capture_output=True, text=True, check=False)
    assert ended.returncode == 1, (words, ended)
    assert "Traceback" not in ended.stderr, (words, ended)
    *_, said = ended.stderr.splitlines()  # after progress
    assert said.startswith("error: "), (words, ended)
    assert extra_of(said) == extra, (words, said)
    print(f"dptse {' '.join(words)}\n  {said}")


def extra_of(message: str) -> str:
    """Return the extra that a message names."""
    found = re.search(r"pip install 'dptse-env\[(\w+)\]'", message)
    assert found, message
    return found[1]


if __name__ == "__main__":
    assert Path(sys.prefix) in Path(dptse_env.__file__).parents, dptse_env.__file__
    main(with_train=sys.argv[1:] == ["train"])
