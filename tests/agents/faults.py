"""A study that meets with faults, and a program that runs it.

python -m tests.agents.faults FOLDER [ADDRESS]
"""

import os
import sys
import time
import uuid
from pathlib import Path

import polars as pl

from agents.executors import make_executor
from agents.play import Cell
from agents.study import Place, Study, run
from dptse_env.schedules.rules import OldestFirst

SHORT = "dptse_env:dptse/ShortHighway-v0"
TRACES = "DPTSE_TEST_TRACES"
"""Environment variable: a folder for traces of attempts; none, and no fault befalls."""


class Disturbed(OldestFirst):
    """Oldest first; a fault may befall the process at the first action."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if state is None and TRACES in os.environ:
            self.disturb(Path(os.environ[TRACES]))
        return super().predict(observation, state, episode_start, deterministic)

    def disturb(self, traces):
        (traces / f"played-{uuid.uuid4()}").touch()
        time.sleep(0.3)


class KilledOnce(Disturbed):
    """Kills its process at the first attempt."""

    def disturb(self, traces):
        first = traces / "killed"
        if not first.exists():
            first.touch()
            os.kill(os.getpid(), 9)


def cell(bandwidth, policy):
    keywords = {"bandwidth": bandwidth, "estimator": "random_walk", "horizon": 80}
    return Cell(SHORT, policy, keywords, {"bandwidth": bandwidth})


def study():
    """Return a study of six cells, of which the last one kills its process once."""
    cells = [cell(bandwidth, "tests.agents.faults:Disturbed") for bandwidth in (1, 2, 3, 4, 5)]
    fatal = cell(6, "tests.agents.faults:KilledOnce")
    return Study("faults", (*cells, fatal), (2000, 2001), report)


def report(rows, folder):
    return "\n".join(f"{value:.9f}" for value in rows.sort("bandwidth", "traffic_seed")["reward"])


def rows_of(folder):
    """Return the rows of a finished study, less the order of columns."""
    return pl.read_parquet(folder / "rows.parquet").sort("bandwidth", "traffic_seed")


if __name__ == "__main__":
    executor = make_executor("ray" if len(sys.argv) > 2 else "local", 2, *sys.argv[2:])
    run(study(), Place(Path(sys.argv[1]), executor))
