"""Write the list of functions that other processes compile: `dptse_env.utils.kernel_list`.

python tests/kernel_list.py

To be run after a change of a kernel's or a kept part's arguments, or of what is kept. Every
estimator's first step is compiled anew for it, which takes two minutes of one core.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from numba.core import event

from dptse_env.utils import kernel_list
from dptse_env.utils.compile_ahead import PROCESSES_VARIABLE
from dptse_env.utils.kernel_list import Listed
from dptse_env.utils.registry import name_of_class

ID = "dptse/PrivateHighway-v1"
ESTIMATORS = ("ekf", "ukf", "enkf", "mhe", "recurrent")


def main() -> None:
    """Write the list; with the name of an estimator, print its part of it."""
    if sys.argv[1:]:
        print(kernel_list.written({sys.argv[1]: compiled(sys.argv[1])}))
        return
    lists = {estimator: list(compiled_afresh(estimator)) for estimator in ESTIMATORS}
    kernel_list.PATH.write_text(kernel_list.written(lists), encoding="utf-8")


def compiled_afresh(estimator: str) -> tuple[Listed, ...]:
    """Return what an estimator's first step compiles, in a process with nothing on disk."""
    with tempfile.TemporaryDirectory() as folder:
        output = subprocess.run(
            [sys.executable, __file__, estimator],
            env=os.environ | {"NUMBA_CACHE_DIR": folder, PROCESSES_VARIABLE: "0"},
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        ).stdout
    return kernel_list.read(output, estimator)


def compiled(estimator: str) -> list[Listed]:
    """Return the kept functions that an estimator's first step compiles, in an order to compile."""
    listener = _Listener()
    with event.install_listener("numba:compile", listener):
        env = gym.make(ID, estimator=estimator)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()
    return list(_backwards(listener.kernels))


@dataclass
class _Compiled:
    """A compiled function, None if it is not kept, and what was compiled for it before it."""

    entry: Listed | None = None
    parts: list[_Compiled] = field(default_factory=list)


def _backwards(compiled: list[_Compiled]) -> Iterator[Listed]:
    """Yield kept functions after their parts, and otherwise the last one first.

    The process that starts others begins with the first function, and so they meet in the middle.
    """
    for function in reversed(compiled):
        yield from _backwards(function.parts)
        if function.entry is not None:
            yield function.entry


class _Listener(event.Listener):
    """Collects what is compiled for each kernel that Python calls."""

    def __init__(self) -> None:
        self.kernels: list[_Compiled] = []
        self._levels = [self.kernels]

    def on_start(self, happened: Any) -> None:
        begun = _Compiled()
        self._levels[-1].append(begun)
        self._levels.append(begun.parts)

    def on_end(self, happened: Any) -> None:
        self._levels.pop()
        dispatcher = happened.data["dispatcher"]
        if hasattr(dispatcher._cache, "end_turn"):
            path = name_of_class(dispatcher.py_func)
            self._levels[-1][-1].entry = Listed(path, tuple(happened.data["args"]))


if __name__ == "__main__":
    main()
