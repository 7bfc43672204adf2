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
from typing import Any

import gymnasium as gym
from numba.core import event

from dptse_env.utils import kernel_list
from dptse_env.utils.compile_ahead import PROCESSES_VARIABLE
from dptse_env.utils.kernel_list import Listed

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
    # This process begins with the first kernels: others begin with the last ones. Within a kernel,
    # parts come before what calls them.
    return [entry for kernel in reversed(listener.kernels) for entry in kernel]


class _Listener(event.Listener):
    """Collects what is compiled and kept, a list for each kernel that Python calls."""

    def __init__(self) -> None:
        self.kernels: list[list[Listed]] = []
        self._depth = 0

    def on_start(self, happened: Any) -> None:
        if self._depth == 0:
            self.kernels.append([])
        self._depth += 1

    def on_end(self, happened: Any) -> None:
        self._depth -= 1
        dispatcher = happened.data["dispatcher"]
        if hasattr(dispatcher._cache, "end_turn"):
            path = kernel_list.path_of(dispatcher.py_func)
            self.kernels[-1].append(Listed(path, tuple(happened.data["args"])))


if __name__ == "__main__":
    main()
